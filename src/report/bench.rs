//! What `tiface bench` measured: speed against error, as a table, as plots, as a page and as `bench.json`.
//!
//! Every time is taken together with that of a fixed piece of arithmetic ([`Round::reference`]) in the same round, so
//! that two results compare as ratios, on a machine that others use too ([`BenchResult::against`]).

mod compare;
mod plot;

pub use compare::{Change, Comparison};

use super::{STYLE, duration, fill, picture_url};
use crate::{Error, Result};
use minijinja::context;
use serde::{Deserialize, Serialize};
use std::fmt::Write;

/// Number of the format of `bench.json`; another one is refused.
const FORMAT: u32 = 1;

/// Wall and CPU seconds of some work. The CPU's are those of all threads together.
#[derive(Clone, Copy, Debug, Default, PartialEq, Serialize, Deserialize)]
pub struct Seconds {
    /// By the clock.
    pub wall: f64,
    /// Of all threads, user and system.
    pub cpu: f64,
}

/// Times of one piece of work and, in the same moment, of the reference arithmetic.
#[derive(Clone, Copy, Debug, Default, PartialEq, Serialize, Deserialize)]
pub struct Round {
    /// The work.
    pub work: Seconds,
    /// The reference arithmetic: the mean of once before and once after.
    pub reference: Seconds,
}

/// A figure of the rows of a sweep.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
pub struct Measure {
    /// What a person calls it, with its unit: `PSNR, dB`.
    pub name: String,
    /// Digits after the point.
    pub digits: usize,
    /// Is more better? `None` for what is only counted.
    pub more_is_better: Option<bool>,
    /// Differences up to this one are noise: of the unit, and as a share of the value.
    pub noise: (f64, f64),
}

impl Measure {
    /// A figure of which more is better; `noise` in its unit.
    pub fn more(name: &str, digits: usize, noise: f64) -> Measure {
        Measure { name: name.into(), digits, more_is_better: Some(true), noise: (noise, 0.0) }
    }

    /// A figure of which less is better; `noise` as a share.
    pub fn less(name: &str, digits: usize, noise: f64) -> Measure {
        Measure { name: name.into(), digits, more_is_better: Some(false), noise: (0.0, noise) }
    }

    /// Differences from a value up to this one are noise.
    fn noise_of(&self, value: f64) -> f64 {
        self.noise.0.max(self.noise.1 * value.abs())
    }

    /// A figure that is neither good nor bad.
    pub fn count(name: &str) -> Measure {
        Measure { name: name.into(), digits: 0, more_is_better: None, noise: (0.0, 0.0) }
    }
}

/// One choice: what it costs and how good it is.
#[derive(Clone, Debug, Default, PartialEq, Serialize, Deserialize)]
pub struct Row {
    /// Choices that are drawn as one line: a field, a method.
    pub series: String,
    /// The choice, a few words.
    pub choice: String,
    /// Times; of repetitions the median counts, of parts their sum.
    pub rounds: Vec<Round>,
    /// Are the rounds parts of the work, one after the other?
    pub parts: bool,
    /// Most memory that the process had meanwhile, MiB; `None` where the system does not say.
    pub memory_mib: Option<f64>,
    /// A figure for each measure of the sweep.
    pub figures: Vec<Option<f64>>,
}

impl Row {
    /// Wall and CPU seconds: the median of repetitions, the sum of parts.
    pub fn seconds(&self) -> Seconds {
        let of = |take: fn(&Seconds) -> f64| {
            let times: Vec<f64> = self.rounds.iter().map(|r| take(&r.work)).collect();
            if self.parts { times.iter().sum() } else { median(times) }
        };
        Seconds { wall: of(|s| s.wall), cpu: of(|s| s.cpu) }
    }
}

/// Median; 0 of nothing.
fn median(mut values: Vec<f64>) -> f64 {
    values.sort_by(f64::total_cmp);
    let n = values.len();
    if n == 0 { 0.0 } else { 0.5 * (values[(n - 1) / 2] + values[n / 2]) }
}

/// One decision and its choices.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
pub struct Sweep {
    /// Its word on the command line.
    pub name: String,
    /// What is decided.
    pub title: String,
    /// How it was measured.
    pub note: String,
    /// What the rows' figures are; the first is drawn over time.
    pub measures: Vec<Measure>,
    /// Does the time by the clock decide? Else that of the CPU, which a busy machine leaves alone.
    #[serde(default)]
    pub by_wall: bool,
    /// The choices.
    pub rows: Vec<Row>,
}

/// Heading of the choices.
const CHOICE: &str = "choice";

impl Sweep {
    /// The time of a row that decides: of the CPU, or by the clock.
    fn time(&self, row: &Row) -> f64 {
        let Seconds { wall, cpu } = row.seconds();
        if self.by_wall { wall } else { cpu }
    }

    /// Which rows are better in the first measure, beyond its noise, than all that take less time: the Pareto front.
    pub fn front(&self) -> Vec<bool> {
        let mut front = vec![false; self.rows.len()];
        let Some((measure, more)) = self.measures.first().and_then(|m| Some((m, m.more_is_better?))) else {
            return front;
        };
        let place = |(i, row): (usize, &Row)| Some((i, self.time(row), row.figures.first().copied()??));
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

    /// Headings and cells of its table, and whether a row is on the front. The first column is the series, if there are
    /// any; then the choice.
    fn table(&self) -> (Vec<String>, Vec<(bool, Vec<String>)>) {
        let mut headings: Vec<String> = ["", CHOICE, "CPU", "wall", "memory, MiB"].map(String::from).into();
        headings.extend(self.measures.iter().map(|m| m.name.clone()));
        let rows = self.rows.iter().zip(self.front()).map(|(row, front)| {
            let Seconds { wall, cpu } = row.seconds();
            let memory = row.memory_mib.map_or("–".into(), |m| format!("{m:.0}"));
            let mut cells =
                vec![row.series.clone(), row.choice.clone(), short_time(cpu), short_time(wall), memory];
            let figure =
                |(m, v): (&Measure, &Option<f64>)| v.map_or("–".into(), |v| format!("{v:.*}", m.digits));
            cells.extend(self.measures.iter().zip(&row.figures).map(figure));
            (front, cells)
        });
        let mut rows: Vec<(bool, Vec<String>)> = rows.collect();
        if rows.iter().all(|(_, cells)| cells[0].is_empty()) {
            headings.remove(0);
            rows.iter_mut().for_each(|(_, cells)| drop(cells.remove(0)));
        }
        (headings, rows)
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

/// Where something was measured.
#[derive(Clone, Debug, Default, PartialEq, Serialize, Deserialize)]
pub struct Machine {
    /// Operating system and processor family.
    pub system: String,
    /// The processor's own name, if the system says it.
    pub processor: String,
    /// Threads that were used.
    pub threads: usize,
}

/// Everything that was measured.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
pub struct BenchResult {
    format: u32,
    /// Version of the program.
    pub version: String,
    /// Where.
    pub machine: Machine,
    /// The capture's name.
    pub capture: String,
    /// Digest of the capture and all settings: results of another one compare nothing.
    pub identity: String,
    /// The sweeps, in order.
    pub sweeps: Vec<Sweep>,
}

impl BenchResult {
    /// Nothing measured yet.
    pub fn new(machine: Machine, capture: String, identity: String) -> BenchResult {
        let version = env!("CARGO_PKG_VERSION").into();
        BenchResult { format: FORMAT, version, machine, capture, identity, sweeps: Vec::new() }
    }

    /// Reads the text of a `bench.json`; `name` is for messages.
    ///
    /// # Errors
    ///
    /// It is no such file, or of another format.
    pub fn parse(text: &str, name: &str) -> Result<BenchResult> {
        let hint = "name the bench.json that `tiface bench` wrote";
        let damaged = |e| Error::cannot(format!("`{name}` is no result of a bench: {e}"), hint);
        let value: serde_json::Value = serde_json::from_str(text).map_err(damaged)?;
        if let Some(other) = value["format"].as_u64().filter(|f| *f != u64::from(FORMAT)) {
            return Err(Error::cannot(
                format!("`{name}` has format {other} of results, this program knows {FORMAT}"),
                "measure again with this program",
            ));
        }
        let result: BenchResult = serde_json::from_value(value).map_err(damaged)?;
        let finite = result.sweeps.iter().flat_map(|s| &s.rows).all(|row| {
            row.rounds.iter().all(|Round { work, reference }| {
                [work.wall, work.cpu].iter().all(|t| *t >= 0.0) && reference.wall > 0.0 && reference.cpu > 0.0
            })
        });
        let widths =
            result.sweeps.iter().all(|s| s.rows.iter().all(|row| row.figures.len() == s.measures.len()));
        if !finite || !widths {
            let what = format!("`{name}` is damaged: times or figures are missing, or no times");
            return Err(Error::cannot(what, hint));
        }
        Ok(result)
    }

    /// Refuses a result of another capture or of other settings: nothing in it compares.
    ///
    /// # Errors
    ///
    /// It is one.
    pub fn comparable_with(&self, other: &BenchResult) -> Result<()> {
        let [mine, theirs] = [self, other].map(|r| r.machine.threads);
        if mine != theirs {
            return Err(Error::cannot(
                format!("the older result was measured on {mine} threads, this one is on {theirs}"),
                format!("compare on as many: `RAYON_NUM_THREADS={mine}`"),
            ));
        }
        if self.identity == other.identity {
            return Ok(());
        }
        let hint = "repeat the command that made it, with this program";
        let (old, new) = (&self.capture, &other.capture);
        let what = if old == new { "with other settings or photographs" } else { "of another capture" };
        Err(Error::cannot(format!("the older result was measured {what} (`{old}`, now `{new}`)"), hint))
    }

    /// `bench.json`.
    pub fn json(&self) -> String {
        format!("{}\n", serde_json::to_string_pretty(self).unwrap_or_default())
    }

    /// The tables, for a terminal. A star marks what no other choice beats in time and error together.
    pub fn text(&self) -> String {
        let mut out = String::new();
        for sweep in &self.sweeps {
            let (headings, rows) = sweep.table();
            let _ = writeln!(out, "\n{} ({})\n{}", sweep.title, sweep.name, sweep.note);
            let all: Vec<Vec<String>> =
                [headings].into_iter().chain(rows.iter().map(|r| r.1.clone())).collect();
            let words = if all[0][0] == CHOICE { 1 } else { 2 };
            for (i, line) in aligned(&all, words).into_iter().enumerate() {
                let star = if i > 0 && rows[i - 1].0 { '*' } else { ' ' };
                let _ = writeln!(out, "{star} {line}");
            }
        }
        out
    }

    /// The tables as Markdown, one a sweep.
    pub fn markdown(&self) -> String {
        let mut out = String::new();
        let line = |cells: &[String]| {
            let cells: Vec<String> = cells.iter().map(|c| c.replace('|', "\\|")).collect();
            format!("| {} |\n", cells.join(" | "))
        };
        for sweep in &self.sweeps {
            let (headings, rows) = sweep.table();
            let _ = write!(out, "\n**{}** {}\n\n{}", sweep.title, sweep.note, line(&headings));
            out += &line(&vec!["---".into(); headings.len()]);
            for (front, mut cells) in rows {
                if front {
                    let choice = headings.iter().position(|h| h == CHOICE).unwrap_or(0);
                    cells[choice] = format!("**{}**", cells[choice]);
                }
                out += &line(&cells);
            }
        }
        out.trim_start().into()
    }

    /// One drawing a sweep with an error to draw: its name, and an SVG file.
    ///
    /// # Errors
    ///
    /// It cannot be drawn: an error of the program.
    pub fn plots(&self) -> Result<Vec<(String, String)>> {
        let drawn = |sweep: &&Sweep| sweep.front().contains(&true);
        self.sweeps.iter().filter(drawn).map(|sweep| Ok((sweep.name.clone(), plot::svg(sweep)?))).collect()
    }

    /// The page: plots and tables.
    ///
    /// # Errors
    ///
    /// It cannot be drawn: an error of the program.
    pub fn html(&self, comparison: Option<&Comparison>) -> Result<String> {
        let plots = self.plots()?;
        let sweeps: Vec<_> = self
            .sweeps
            .iter()
            .map(|sweep| {
                let (headings, rows) = sweep.table();
                let plot = plots.iter().find(|(name, _)| *name == sweep.name);
                let plot = plot.map(|(_, svg)| picture_url(svg.as_bytes()));
                let words = if headings[0] == CHOICE { 1 } else { 2 };
                context! { title => sweep.title, note => sweep.note, headings, rows, plot, words }
            })
            .collect();
        fill(
            include_str!("bench/page.html"),
            context! {
                style => STYLE, title => format!("{}: speed against error", self.capture), machine => self.machine,
                version => self.version, sweeps, comparison => comparison.map(Comparison::lines),
            },
        )
    }
}

/// Rows of cells in columns; the first `left` columns begin at the left.
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
pub(super) mod tests {
    use super::*;

    pub(super) fn row(choice: &str, times: &[f64], figure: f64) -> Row {
        let both = |s: f64| Seconds { wall: s / 2.0, cpu: s };
        let rounds = times.iter().map(|&t| Round { work: both(t), reference: both(0.1) }).collect();
        Row {
            series: "field".into(),
            choice: choice.into(),
            rounds,
            figures: vec![Some(figure)],
            ..Row::default()
        }
    }

    pub(super) fn result(rows: Vec<Row>) -> BenchResult {
        let sweep = Sweep {
            name: "steps".into(),
            title: "Training <steps>".into(),
            note: "As measured.".into(),
            measures: vec![Measure::more("PSNR, dB", 2, 0.2)],
            by_wall: false,
            rows,
        };
        let mut result = BenchResult::new(Machine::default(), "head & shoulders".into(), "id".into());
        result.sweeps.push(sweep);
        result
    }

    #[test]
    fn the_front_is_what_nothing_beats_in_both() {
        let rows = vec![
            row("a", &[1.0], 30.0),
            row("b", &[2.0], 29.0),
            row("c", &[3.0], 31.0),
            row("d", &[3.0], 31.0),
        ];
        let mut sweep = result(rows).sweeps.remove(0);
        // b takes longer than a and is worse; d is as good as c
        assert_eq!(sweep.front(), [true, false, true, false]);
        // 1 dB is not worth three times the time where it is noise
        sweep.measures = vec![Measure::more("PSNR, dB", 2, 1.0)];
        assert_eq!(sweep.front(), [true, false, false, false]);
        sweep.measures = vec![Measure::less("mm", 2, 0.0)];
        assert_eq!(sweep.front(), [true, true, false, false]);
        sweep.rows[1].figures = vec![None];
        assert_eq!(sweep.front(), [true, false, false, false]);
        // by the clock, where that decides
        sweep.rows[2].rounds[0].work.wall = 0.01;
        sweep.by_wall = true;
        assert_eq!(sweep.front(), [true, false, true, false]);
    }

    #[test]
    fn repetitions_count_by_their_median_and_parts_by_their_sum() {
        let mut row = row("a", &[1.0, 9.0, 2.0], 1.0);
        assert_eq!(row.seconds(), Seconds { wall: 1.0, cpu: 2.0 });
        row.parts = true;
        assert_eq!(row.seconds(), Seconds { wall: 6.0, cpu: 12.0 });
    }

    #[test]
    fn only_results_of_as_many_threads_compare() {
        let mut other = result(Vec::new());
        assert!(result(Vec::new()).comparable_with(&other).is_ok());
        other.machine.threads = 16;
        let error = result(Vec::new()).comparable_with(&other).unwrap_err();
        assert!(error.to_string().contains("this one is on 16") && error.hint().contains("NUM_THREADS=0"));
    }

    #[test]
    fn what_is_written_is_read_back_and_nothing_else() {
        let result = result(vec![row("a", &[1.0, 0.1 + 0.2], 30.123_456_789)]);
        assert_eq!(BenchResult::parse(&result.json(), "b").unwrap(), result);
        let wrong = |text: &str| BenchResult::parse(text, "b.json").unwrap_err().to_string();
        assert!(wrong("{}").contains("`b.json` is no result"));
        assert!(wrong(&result.json().replacen("\"format\": 1", "\"format\": 7", 1)).contains("format 7"));
        assert!(wrong(&result.json().replacen("30.123456789\n", "1, 2\n", 1)).contains("damaged"));
    }

    #[test]
    fn tables_page_and_plots_hold_every_row_and_escape_names() {
        let result = result(vec![row("<b>", &[1.5], 30.0), row("c", &[100.0], 33.333)]);
        let text = result.text();
        assert!(text.contains("* field  c       1 min 40 s"), "{text}");
        assert!(text.contains("33.33"), "{text}");
        assert!(result.markdown().contains("| field | **c** | 1 min 40 s | 50 s | – | 33.33 |"));
        let page = result.html(None).unwrap();
        assert!(page.contains("&lt;b&gt;") && !page.contains("<b>") && page.contains("data:image/svg+xml"));
        let [(name, svg)] = &result.plots().unwrap()[..] else { panic!() };
        assert!(name == "steps" && svg.contains("PSNR, dB") && svg.contains("&lt;b&gt;"), "{svg}");
        assert_eq!(svg.matches("<circle").count(), 2 + 2, "both points, both on the front");
    }

    #[test]
    fn times_have_a_unit_that_fits() {
        assert_eq!([3e-6, 0.0021, 0.25, 4.0].map(short_time), ["3 µs", "2.1 ms", "250 ms", "4.0 s"]);
    }
}
