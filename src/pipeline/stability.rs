//! Hard cases, each with the largest error met and what it must stay below: what floating point, odd volumes, grazing
//! rays and hard captures do to every part of the line.

#[cfg(feature = "cpu")]
mod captures;
mod case;
mod kernels;
mod rays;
mod sharpness;
mod surfaces;

pub use case::StabilityCase;

use crate::{Monitor, Result};
use std::path::Path;

/// Runs all hard cases; those that learn fields write into the folder `scratch`, which they leave as it then is.
///
/// # Errors
///
/// A scratch folder that cannot be written, a request to stop. What a case finds is no error: it does not hold.
pub fn stability(scratch: &Path, monitor: &dyn Monitor) -> Result<Vec<StabilityCase>> {
    let quick = [surfaces::cases, rays::cases, sharpness::cases, kernels::cases];
    #[cfg(feature = "cpu")]
    let hard = captures::captures();
    #[cfg(not(feature = "cpu"))]
    let hard: [(); 0] = [];
    let (first, total) = (quick.len() as u64, (quick.len() + hard.len()) as u64);
    let mut done = Vec::new();
    for (i, cases) in (1..).zip(quick) {
        done.extend(cases());
        monitor.step(i, total, &[]);
        monitor.check_stop()?;
    }
    #[cfg(feature = "cpu")]
    done.extend(captures::cases(hard, scratch, &|i| {
        monitor.step(first + i, total, &[]);
        monitor.check_stop()
    })?);
    #[cfg(not(feature = "cpu"))]
    let _ = (scratch, first);
    Ok(done)
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::Quiet;

    #[test]
    fn every_hard_case_stays_below_its_bound() {
        let dir = tempfile::tempdir().unwrap();
        let cases = stability(dir.path(), &Quiet).unwrap();
        cases.iter().for_each(|c| {
            println!("{:10} {:64} {:10.2e} {:8.0e} {}", c.group, c.case, c.error, c.bound, c.unit)
        });
        let failed: Vec<_> = cases.iter().filter(|c| !c.holds()).collect();
        assert!(failed.is_empty() && cases.len() > 60, "{failed:#?}");
    }

    #[test]
    fn what_is_no_number_does_not_hold() {
        let of =
            |error| StabilityCase { group: "rays", case: String::new(), error, unit: "rays", bound: 0.0 };
        assert!(of(0.0).holds() && !of(1e-300).holds() && !of(f64::NAN).holds());
        assert!(case::worst([1.0, f64::NAN, 2.0]).is_nan() && case::worst([1.0, 2.0]) == 2.0);
    }
}
