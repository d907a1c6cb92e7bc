//! Every hard case stays below its bound.

#[path = "support/stability/mod.rs"]
mod stability;

use stability::case::{StabilityCase, worst};

#[test]
fn every_hard_case_stays_below_its_bound() {
    let dir = tempfile::tempdir().unwrap();
    let cases = stability::stability(dir.path()).unwrap();
    cases.iter().for_each(|c| println!("{c}"));
    let failed: Vec<_> = cases.iter().filter(|c| !c.holds()).collect();
    assert!(failed.is_empty() && cases.len() > 60, "{failed:#?}");
}

#[test]
fn what_is_no_number_does_not_hold() {
    let of = |error| StabilityCase { group: "rays", case: String::new(), error, unit: "rays", bound: 0.0 };
    assert!(of(0.0).holds() && !of(1e-300).holds() && !of(f64::NAN).holds());
    assert!(worst([1.0, f64::NAN, 2.0]).is_nan() && worst([1.0, 2.0]) == 2.0);
}
