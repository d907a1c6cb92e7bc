//! The results of `tiface bench`: speed against error, as tables, as a page and as `bench.json`.

use super::{Chart, Curve, STYLE, duration, fill};
use minijinja::context;
use serde::{Deserialize, Serialize};
use std::borrow::Cow;
use std::fmt::Write;
use tiface_base::Result;

/// Cost of some work.
#[derive(Clone, Copy, Debug, Default, PartialEq, Serialize, Deserialize)]
pub struct WorkCost {
    /// Seconds by the clock.
    pub wall_s: f64,
    /// Seconds of all threads together, user and system.
    pub cpu_s: f64,
    /// Most memory that the process had meanwhile, MiB; `None` where the system does not say.
    pub memory_mib: Option<f64>,
}

impl std::ops::Add for WorkCost {
    type Output = WorkCost;

    /// One after the other.
    fn add(self, next: WorkCost) -> WorkCost {
        let memory_mib = self.memory_mib.into_iter().chain(next.memory_mib).reduce(f64::max);
        WorkCost { wall_s: self.wall_s + next.wall_s, cpu_s: self.cpu_s + next.cpu_s, memory_mib }
    }
}

/// A figure of the rows of a sweep.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
pub struct Measure {
    /// Name for readers, with its unit: `PSNR, dB`.
    pub name: Cow<'static, str>,
    /// Digits after the point.
    pub digits: usize,
    /// Whether more is better; `None` for counts.
    pub more_is_better: Option<bool>,
    /// Differences up to this one are noise: of the unit, and as a share of the value.
    pub noise: (f64, f64),
}

impl Measure {
    /// Differences from a value up to this one are noise.
    fn noise_of(&self, value: f64) -> f64 {
        self.noise.0.max(self.noise.1 * value.abs())
    }
}

/// One choice, with its cost and quality.
#[derive(Clone, Debug, Default, PartialEq, Serialize, Deserialize)]
pub struct Row {
    /// Choices that are drawn as one line: a field, a method.
    pub series: Cow<'static, str>,
    /// The choice, a few words.
    pub choice: String,
    /// Its cost.
    #[serde(flatten)]
    pub cost: WorkCost,
    /// A figure for each measure of the sweep.
    pub figures: Vec<Option<f64>>,
}

/// One decision and its choices.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
pub struct Sweep {
    /// Its word on the command line.
    pub name: Cow<'static, str>,
    /// The decision.
    pub title: Cow<'static, str>,
    /// Method of measurement.
    pub note: String,
    /// Names of the rows' figures; the first is drawn over time.
    pub measures: Vec<Measure>,
    /// The choices.
    pub rows: Vec<Row>,
}

impl Sweep {
    /// Returns which rows are better in the first measure, beyond its noise, than all that take
    /// less time: the Pareto front.
    pub fn front(&self) -> Vec<bool> {
        let mut front = vec![false; self.rows.len()];
        let Some((measure, more)) = self.measures.first().and_then(|m| Some((m, m.more_is_better?))) else {
            return front;
        };
        let place = |(i, row): (usize, &Row)| Some((i, row.cost.cpu_s, row.figures.first().copied()??));
        let mut places: Vec<(usize, f64, f64)> = self.rows.iter().enumerate().filter_map(place).collect();
        // of equal times the better first
        let better_first = |a: f64, b: f64| if more { b.total_cmp(&a) } else { a.total_cmp(&b) };
        places.sort_by(|a, b| a.1.total_cmp(&b.1).then(better_first(a.2, b.2)));
        let mut best: Option<f64> = None;
        for (i, _, figure) in places {
            let gain = |best: f64| if more { figure - best } else { best - figure };
            if best.is_none_or(|best| gain(best) > measure.noise_of(best)) {
                (front[i], best) = (true, Some(figure));
            }
        }
        front
    }

    /// Headings and cells of its table, and whether a row is on the front.
    fn table(&self) -> (Vec<&str>, Vec<(bool, Vec<String>)>) {
        let mut headings = vec!["", "choice", "CPU", "wall", "memory, MiB"];
        headings.extend(self.measures.iter().map(|m| &*m.name));
        let rows = self.rows.iter().zip(self.front()).map(|(row, front)| {
            let WorkCost { wall_s, cpu_s, memory_mib } = row.cost;
            let figure = |(value, digits): (Option<f64>, usize)| {
                value.map_or("–".into(), |value| format!("{value:.digits$}"))
            };
            let [cpu, wall] = [cpu_s, wall_s].map(short_time);
            let mut cells =
                vec![row.series.to_string(), row.choice.clone(), cpu, wall, figure((memory_mib, 0))];
            let figures = row.figures.iter().copied().zip(self.measures.iter().map(|m| m.digits));
            cells.extend(figures.map(figure));
            (front, cells)
        });
        (headings, rows.collect())
    }

    /// Returns the first measure over CPU seconds, a line for each series: a part of a page.
    fn drawing(&self) -> String {
        let mut curves: Vec<Curve> = Vec::new();
        for row in &self.rows {
            let Some(value) = row.figures.first().copied().flatten() else { continue };
            match curves.iter_mut().find(|curve| curve.name == row.series) {
                Some(curve) => curve.points.push((row.cost.cpu_s, value)),
                None => {
                    curves.push(Curve { name: row.series.to_string(), points: vec![(row.cost.cpu_s, value)] })
                }
            }
        }
        for curve in &mut curves {
            curve.points.sort_by(|a, b| a.0.total_cmp(&b.0));
        }
        let title = self.measures.first().map_or(String::new(), |m| format!("{} over CPU seconds", m.name));
        if curves.is_empty() { String::new() } else { Chart { title, curves }.html() }
    }
}

/// `12 µs`, `3.4 ms`, `2 min 05 s`.
fn short_time(seconds: f64) -> String {
    match seconds {
        s if s < 1e-3 => format!("{:.0} µs", s * 1e6),
        s if s < 0.0995 => format!("{:.1} ms", s * 1e3),
        s if s < 0.995 => format!("{:.0} ms", s * 1e3),
        s => duration(s),
    }
}

/// All measurements, and the machine that made them.
#[derive(Clone, Debug, Default, PartialEq, Serialize, Deserialize)]
pub struct BenchResult {
    /// Version of the program.
    pub version: Cow<'static, str>,
    /// Operating system and CPU family.
    pub system: String,
    /// The CPU's own name, if the system says it.
    pub processor: String,
    /// Threads that were used.
    pub threads: usize,
    /// The capture's name.
    pub capture: String,
    /// The settings, as TOML.
    pub settings: String,
    /// Words of the sweeps that were asked for.
    pub asked: Vec<String>,
    /// The sweeps, in order.
    pub sweeps: Vec<Sweep>,
}

impl BenchResult {
    /// Returns whether these are results of the same bench, which may have been stopped: of the
    /// same program, machine, settings and sweeps.
    pub fn is_part_of(&self, begun: &BenchResult) -> bool {
        let BenchResult { capture, sweeps, .. } = begun.clone();
        BenchResult { capture, sweeps, ..self.clone() } == *begun
    }

    /// `bench.json`.
    pub fn json(&self) -> String {
        format!("{:#}\n", serde_json::json!(self))
    }

    /// Returns the tables, for a terminal. A star marks what no other choice beats in time and
    /// error together.
    pub fn text(&self) -> String {
        let mut out = String::new();
        for sweep in &self.sweeps {
            let (headings, rows) = sweep.table();
            let _ = writeln!(out, "\n{} ({})\n{}", sweep.title, sweep.name, sweep.note);
            let headings = headings.into_iter().map(String::from).collect();
            let all: Vec<Vec<String>> =
                [headings].into_iter().chain(rows.iter().map(|r| r.1.clone())).collect();
            for (i, line) in aligned(&all, 2).into_iter().enumerate() {
                let star = if i > 0 && rows[i - 1].0 { '*' } else { ' ' };
                let _ = writeln!(out, "{star} {line}");
            }
        }
        out
    }

    /// Returns the page: drawings and tables.
    ///
    /// # Errors
    ///
    /// It cannot be filled in: an error of the program.
    pub fn html(&self) -> Result<String> {
        let sweep = |sweep: &Sweep| {
            let (headings, rows) = sweep.table();
            context! { title => sweep.title, note => sweep.note, headings, rows, drawing => sweep.drawing() }
        };
        let sweeps: Vec<_> = self.sweeps.iter().map(sweep).collect();
        let title = format!("{}: speed against error", self.capture);
        fill(include_str!("bench/page.html"), "", context! { style => STYLE, title, result => self, sweeps })
    }
}

/// Returns the rows of cells in columns; the first `left` columns begin at the left.
fn aligned(rows: &[Vec<String>], left: usize) -> Vec<String> {
    let columns = rows.first().map_or(0, Vec::len);
    let wide = |k: usize| rows.iter().map(|r| r[k].chars().count()).max().unwrap_or(0);
    let widths: Vec<usize> = (0..columns).map(wide).collect();
    let cell = |(k, text): (usize, &String)| {
        if k < left { format!("{text:<0$}", widths[k]) } else { format!("{text:>0$}", widths[k]) }
    };
    let line = |row: &Vec<String>| row.iter().enumerate().map(cell).collect::<Vec<_>>().join("  ");
    rows.iter().map(|row| line(row).trim_end().to_owned()).collect()
}

#[cfg(test)]
mod tests {
    use super::*;

    const PSNR: Measure =
        Measure { name: Cow::Borrowed("PSNR, dB"), digits: 2, more_is_better: Some(true), noise: (0.2, 0.0) };

    fn row(choice: &str, seconds: f64, figure: f64) -> Row {
        let cost = WorkCost { wall_s: seconds / 2.0, cpu_s: seconds, memory_mib: None };
        Row { series: "field".into(), choice: choice.into(), cost, figures: vec![Some(figure)] }
    }

    fn sweep(rows: Vec<Row>) -> Sweep {
        let (title, note) = ("Training <steps>".into(), "As measured.".into());
        Sweep { name: "steps".into(), title, note, measures: vec![PSNR], rows }
    }

    #[test]
    fn the_front_is_what_nothing_beats_in_both() {
        let rows = vec![row("a", 1.0, 30.0), row("b", 2.0, 29.0), row("c", 3.0, 31.0), row("d", 3.0, 31.0)];
        let mut sweep = sweep(rows);
        // b takes longer than a and is worse; d is as good as c
        assert_eq!(sweep.front(), [true, false, true, false]);
        // 1 dB is not worth three times the time where it is noise
        sweep.measures = vec![Measure { noise: (1.0, 0.0), ..PSNR }];
        assert_eq!(sweep.front(), [true, false, false, false]);
        sweep.measures = vec![Measure { more_is_better: Some(false), noise: (0.0, 0.0), ..PSNR }];
        assert_eq!(sweep.front(), [true, true, false, false]);
        sweep.rows[1].figures = vec![None];
        assert_eq!(sweep.front(), [true, false, false, false]);
    }

    #[test]
    fn costs_of_parts_add_up_but_for_their_memory() {
        let cost = |s: f64, memory_mib| WorkCost { wall_s: s, cpu_s: 2.0 * s, memory_mib };
        assert_eq!(cost(1.0, Some(5.0)) + cost(2.0, Some(4.0)), cost(3.0, Some(5.0)));
        assert_eq!(cost(1.0, None) + cost(2.0, Some(4.0)), cost(3.0, Some(4.0)));
    }

    #[test]
    fn tables_and_page_hold_every_row_and_escape_names() {
        let sweeps = vec![sweep(vec![row("<u>", 1.5, 30.0), row("c", 100.0, 33.333)])];
        let result = BenchResult { capture: "head & shoulders".into(), sweeps, ..BenchResult::default() };
        let text = result.text();
        assert!(text.contains("* field  c       1 min 40 s") && text.contains("33.33"), "{text}");
        let page = result.html().unwrap();
        assert!(page.contains("&lt;u&gt;") && !page.contains("<u>"), "{page}");
        assert!(page.contains("PSNR, dB over CPU seconds") && page.contains("<polyline"), "{page}");
        let value: serde_json::Value = serde_json::from_str(&result.json()).unwrap();
        assert_eq!(value["sweeps"][0]["rows"][1]["cpu_s"], 100.0);
    }

    #[test]
    fn results_that_were_read_again_belong_to_the_bench_that_wrote_them() {
        let sweeps = vec![sweep(vec![row("a", 1.5, 30.0)])];
        let begun = BenchResult {
            asked: vec!["steps".into()],
            settings: "seed = 1".into(),
            ..BenchResult::default()
        };
        let stopped = BenchResult { capture: "head".into(), sweeps, ..begun.clone() };
        let read: BenchResult = serde_json::from_str(&stopped.json()).unwrap();
        assert_eq!(read, stopped);
        assert!(read.is_part_of(&begun));
        assert!(!read.is_part_of(&BenchResult { settings: "seed = 2".into(), ..begun.clone() }));
        assert!(!read.is_part_of(&BenchResult { asked: vec!["hash".into()], ..begun }));
    }

    #[test]
    fn times_have_a_unit_that_fits() {
        assert_eq!([3e-6, 0.0021, 0.25, 4.0].map(short_time), ["3 µs", "2.1 ms", "250 ms", "4.0 s"]);
    }
}
