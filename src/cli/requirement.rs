//! `--require`: what the result of a run must reach.

use crate::pipeline::Stage;
use crate::run::Done;
use serde_json::Value;
use tiface_base::{Error, Result};

/// A requirement of `--require`.
#[derive(Debug, PartialEq)]
pub(super) enum Requirement {
    Watertight,
    Psnr(f64),
}

impl Requirement {
    pub fn parse(text: &str) -> Result<Requirement> {
        let requirement = match text.split_once('=') {
            Some(("psnr", db)) => db.parse().ok().filter(|v: &f64| v.is_finite()).map(Requirement::Psnr),
            None if text == "watertight" => Some(Requirement::Watertight),
            _ => None,
        };
        requirement.ok_or_else(|| {
            Error::usage(format!("there is no requirement `{text}`"), "use watertight or psnr=DB")
        })
    }

    pub fn check(&self, done: &[(Stage, Done)]) -> Result<()> {
        let summary = |stage| done.iter().find(|(s, _)| *s == stage).map(|(_, d)| &d.summary);
        match self {
            Requirement::Watertight if summary(Stage::Mesh).is_some_and(|m| m["closed"] == true) => Ok(()),
            Requirement::Watertight => {
                Err(Error::below("the mesh is not watertight", "`tiface check RUN` says why"))
            }
            Requirement::Psnr(least) => {
                let metrics = summary(Stage::Metrics).unwrap_or(&Value::Null);
                let sets = metrics.as_object().into_iter().flat_map(|m| m.values());
                let best = sets
                    .filter_map(|set| set["head"]["mean"]["psnr_masked"].as_f64())
                    .fold(f64::NEG_INFINITY, f64::max);
                if best >= *least {
                    return Ok(());
                }
                let found = if best.is_finite() { format!("{best:.2} dB") } else { "unknown".into() };
                Err(Error::below(
                    format!("PSNR is {found}, required is {least} dB"),
                    "train longer, or lower the requirement",
                ))
            }
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use serde_json::json;

    fn done(summary: Value) -> Done {
        Done { digest: String::new(), summary, skipped: false }
    }

    #[test]
    fn bars_are_parsed_and_missed_with_exit_code_3() {
        assert_eq!(Requirement::parse("psnr=28").unwrap(), Requirement::Psnr(28.0));
        assert_eq!(Requirement::parse("psnr=nan").unwrap_err().kind().code(), 2);
        assert_eq!(Requirement::parse("beauty").unwrap_err().kind().code(), 2);
        let metrics = json!({
            "tface": {"head": {"mean": {"psnr_masked": 25.0}}},
            "ensemble": {"head": {"mean": {"psnr_masked": 27.5}}},
            "truth_percent_of_head": {"accuracy_mean": 99.0},
        });
        let stages = [(Stage::Mesh, done(json!({"closed": true}))), (Stage::Metrics, done(metrics))];
        assert!(
            Requirement::Watertight.check(&stages).is_ok() && Requirement::Psnr(27.0).check(&stages).is_ok()
        );
        assert_eq!(Requirement::Psnr(28.0).check(&stages).unwrap_err().kind().code(), 3);
        assert_eq!(Requirement::Psnr(1.0).check(&[]).unwrap_err().kind().code(), 3);
    }
}
