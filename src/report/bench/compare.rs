//! Two results of the bench: what got slower or worse beyond noise.
//!
//! A time is never compared alone. In each round the work was timed beside the same reference arithmetic, so round
//! `i` of the old result and round `i` of the new one give a ratio of ratios, which a slower or busier machine leaves
//! where it is. The median of those pairs is the change; their spread says how far it can be trusted.

use super::{BenchResult, Measure, Round, Row, median};
use serde::Serialize;
use std::fmt::Write;

/// Changes of a time up to this one say nothing, however small their spread is.
const LEAST: f64 = 0.05;

/// The same where one or two rounds show no spread.
const LEAST_UNKNOWN: f64 = 0.2;

/// A change counts when it is this many standard errors from none.
const SURE: f64 = 3.0;

/// Standard deviations of a normal distribution in a median absolute deviation.
const MAD: f64 = 1.4826;

/// Memory up to this share more is noise, and up to so many MiB.
const MEMORY: (f64, f64) = (0.1, 16.0);

/// One figure in both results.
#[derive(Clone, Debug, PartialEq, Serialize)]
pub struct Change {
    /// The sweep.
    pub sweep: String,
    /// The row.
    pub row: String,
    /// What: `CPU time`, `wall time`, `memory, MiB` or the name of a measure.
    pub what: String,
    /// Before; of times in reference units.
    pub old: f64,
    /// Now.
    pub new: f64,
    /// Change in percent; of a figure that may be 0 the difference in its unit.
    pub change: f64,
    /// What counts as noise, in the same unit.
    pub noise: f64,
    /// Is it worse, or better, beyond noise? `None` within it.
    pub worse: Option<bool>,
}

/// Everything that two results have in common.
#[derive(Clone, Debug, Default, PartialEq, Serialize)]
pub struct Comparison {
    /// Every figure.
    pub changes: Vec<Change>,
    /// Rows that only one result has.
    pub unmatched: Vec<String>,
}

impl Comparison {
    /// What got slower or worse.
    pub fn worse(&self) -> impl Iterator<Item = &Change> {
        self.changes.iter().filter(|c| c.worse == Some(true))
    }

    /// A sentence a change beyond noise, the bad ones first, and what else there is to say.
    pub fn lines(&self) -> Vec<String> {
        let told = |worse: bool| {
            self.changes.iter().filter(move |c| c.worse == Some(worse)).map(move |c| {
                let word = if worse { "worse" } else { "better" };
                let Change { sweep, row, what, old, new, change, noise, .. } = c;
                let unit = if c.is_relative() { " %" } else { "" };
                format!(
                    "{word}: {sweep}, {row}: {what} {old:.4} → {new:.4} ({change:+.2}{unit}, noise {noise:.2}{unit})"
                )
            })
        };
        let mut lines: Vec<String> = told(true).chain(told(false)).collect();
        let same = self.changes.iter().filter(|c| c.worse.is_none()).count();
        lines.push(format!("{same} figures are the same within noise"));
        lines.extend(self.unmatched.iter().map(|row| format!("only in one result: {row}")));
        lines
    }

    /// The same for a terminal.
    pub fn text(&self) -> String {
        self.lines().iter().fold(String::from("\n"), |mut out, line| {
            let _ = writeln!(out, "{line}");
            out
        })
    }
}

impl Change {
    fn is_relative(&self) -> bool {
        self.what.ends_with("time") || self.what.starts_with("memory")
    }
}

impl BenchResult {
    /// Compares this result with an older one of the same capture and settings.
    pub fn against(&self, old: &BenchResult) -> Comparison {
        let mut out = Comparison::default();
        for sweep in &self.sweeps {
            let before = old.sweeps.iter().find(|s| s.name == sweep.name);
            for row in &sweep.rows {
                let named = format!("{} {}", row.series, row.choice).trim().to_owned();
                let same = |r: &&Row| (&r.series, &r.choice) == (&row.series, &row.choice);
                let Some((before, was)) = before.and_then(|s| Some((s, s.rows.iter().find(same)?))) else {
                    out.unmatched.push(format!("{}, {named} (new)", sweep.name));
                    continue;
                };
                let mut add = |what: &str, (old, new, change, noise): (f64, f64, f64, f64), more: bool| {
                    let worse = (change.abs() > noise).then_some((change > 0.0) != more);
                    let (sweep, row, what) = (sweep.name.clone(), named.clone(), what.to_owned());
                    out.changes.push(Change { sweep, row, what, old, new, change, noise, worse });
                };
                add("CPU time", time(&was.rounds, &row.rounds, |r| r.work.cpu / r.reference.cpu), false);
                add("wall time", time(&was.rounds, &row.rounds, |r| r.work.wall / r.reference.wall), false);
                if let (Some(old), Some(new)) = (was.memory_mib, row.memory_mib) {
                    let noise = 100.0 * MEMORY.0.max(MEMORY.1 / old.max(1.0));
                    add("memory, MiB", (old, new, 100.0 * (new / old.max(1.0) - 1.0), noise), false);
                }
                for (measure, new) in sweep.measures.iter().zip(&row.figures) {
                    let place = before.measures.iter().position(|m| m.name == measure.name);
                    let old = place.and_then(|k| was.figures[k]);
                    if let (Some(old), &Some(new), Some(more)) = (old, new, measure.more_is_better) {
                        add(&measure.name, figure(measure, old, new), more);
                    }
                }
            }
            let gone =
                |r: &&Row| !sweep.rows.iter().any(|row| (&r.series, &r.choice) == (&row.series, &row.choice));
            for row in before.iter().flat_map(|s| s.rows.iter().filter(gone)) {
                out.unmatched.push(format!("{}, {} {} (old)", sweep.name, row.series, row.choice));
            }
        }
        out
    }
}

/// Old and new median in reference units, change and noise in percent, by pairs of rounds.
fn time(old: &[Round], new: &[Round], units: fn(&Round) -> f64) -> (f64, f64, f64, f64) {
    let finite = |&(a, b): &(f64, f64)| a > 0.0 && b > 0.0 && a.is_finite() && b.is_finite();
    let pairs: Vec<(f64, f64)> = old.iter().map(units).zip(new.iter().map(units)).filter(finite).collect();
    let logs: Vec<f64> = pairs.iter().map(|(a, b)| (b / a).ln()).collect();
    let middle = median(logs.clone());
    let spread = MAD * median(logs.iter().map(|l| (l - middle).abs()).collect());
    let least = if logs.len() < 3 { LEAST_UNKNOWN } else { LEAST };
    let noise = least.max(SURE * spread / (logs.len().max(1) as f64).sqrt());
    let [a, b] = [|p: &(f64, f64)| p.0, |p: &(f64, f64)| p.1].map(|f| median(pairs.iter().map(f).collect()));
    (a, b, 100.0 * middle.exp_m1(), 100.0 * noise.exp_m1())
}

fn figure(measure: &Measure, old: f64, new: f64) -> (f64, f64, f64, f64) {
    (old, new, new - old, measure.noise_of(old))
}

#[cfg(test)]
mod tests {
    use super::super::tests::{result, row};
    use super::*;

    fn changes(old: &BenchResult, new: &BenchResult) -> Vec<(String, Option<bool>)> {
        new.against(old).changes.into_iter().map(|c| (c.what, c.worse)).collect()
    }

    #[test]
    fn slower_and_worse_beyond_noise_is_named_and_nothing_else() {
        let old = result(vec![row("a", &[1.0, 1.01, 0.99, 1.0, 1.02], 30.0)]);
        assert!(changes(&old, &old).iter().all(|(_, worse)| worse.is_none()));
        let slower = result(vec![row("a", &[1.3, 1.31, 1.3, 1.29, 1.33], 29.9)]);
        let found = changes(&old, &slower);
        assert_eq!(found[0], ("CPU time".into(), Some(true)));
        assert_eq!(found[2], ("PSNR, dB".into(), None), "0.1 dB is noise");
        assert_eq!(slower.against(&old).worse().count(), 2);
        // the way back is a gain
        assert_eq!(changes(&slower, &old)[1], ("wall time".into(), Some(false)));
        let worse = result(vec![row("a", &[1.0, 1.0, 1.0], 29.5)]);
        assert_eq!(changes(&old, &worse)[2], ("PSNR, dB".into(), Some(true)));
    }

    #[test]
    fn a_busy_machine_that_slows_the_reference_too_changes_nothing() {
        let old = result(vec![row("a", &[1.0, 1.0, 1.0], 30.0)]);
        let mut busy = result(vec![row("a", &[2.5, 2.5, 2.5], 30.0)]);
        for round in &mut busy.sweeps[0].rows[0].rounds {
            (round.reference.wall, round.reference.cpu) = (0.125, 0.25);
        }
        assert!(changes(&old, &busy).iter().all(|(_, worse)| worse.is_none()));
    }

    #[test]
    fn wild_or_single_rounds_are_not_trusted() {
        let old = result(vec![row("a", &[1.0, 1.0, 1.0, 1.0], 30.0)]);
        let wild = result(vec![row("a", &[0.6, 1.9, 1.2, 1.3], 30.0)]);
        assert_eq!(changes(&old, &wild)[0].1, None);
        let [one, other] = [1.0, 1.15].map(|t| result(vec![row("a", &[t], 30.0)]));
        assert_eq!(changes(&one, &other)[0].1, None);
    }

    #[test]
    fn rows_of_one_result_alone_are_told() {
        let [old, new] = ["a", "b"].map(|name| result(vec![row(name, &[1.0], 30.0)]));
        let found = new.against(&old);
        assert!(found.changes.is_empty());
        assert_eq!(found.unmatched, ["steps, field b (new)", "steps, field a (old)"]);
    }
}
