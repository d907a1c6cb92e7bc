//! The paper's tables beside our figures: Markdown and JSON.

use serde::Serialize;
use std::fmt::Write;
use tiface_base::math::rng;
use tiface_base::{Error, Result};

/// Measures of a row, in the order of the columns: word, heading, and digits.
pub const MEASURES: [(&str, &str, usize); 7] = [
    ("masked", "PSNR inside the mask, dB", 2),
    ("full", "PSNR of the whole photograph, dB", 2),
    ("region", "PSNR of face and hair, dB", 2),
    ("masked_ssim", "SSIM inside the mask", 3),
    ("full_ssim", "SSIM of the whole photograph", 3),
    ("lpips", "LPIPS of the whole photograph", 3),
    ("seconds", "seconds a view", 2),
];

/// Mark of a row that was evaluated with masks made by its own run.
const OWN_MASKS: &str = " †";

/// Resamplings of an interval.
const RESAMPLES: u64 = 1000;

/// A row of a table: which run it comes from, and which of its pictures.
#[derive(Clone, Copy, Debug, Serialize)]
pub struct ExperimentRow {
    /// The table's word.
    pub table: &'static str,
    /// Its own.
    pub row: &'static str,
    /// Title for readers.
    pub title: &'static str,
    /// The run that makes it.
    pub run: &'static str,
    /// The pictures of that run that are evaluated.
    pub pictures: &'static str,
}

/// An ordering of two rows by a measure, as the paper reports it.
#[derive(Clone, Copy, Debug, Serialize)]
pub struct Ordering {
    /// The table's word.
    pub table: &'static str,
    /// The better row.
    pub better: &'static str,
    /// The worse one, or one as good where `or_equal`.
    pub worse: &'static str,
    /// The measure by which.
    pub by: &'static str,
    /// Whether they may be equal, within a twentieth of a decibel.
    pub or_equal: bool,
}

/// One photograph's figures, in the order of [`MEASURES`]; the last is of the whole row.
pub type ViewRow = [Option<f64>; MEASURES.len() - 1];

/// A row as a capture has it.
#[derive(Clone, Debug, Default, Serialize)]
pub struct Measured {
    /// Names of the photographs.
    pub views: Vec<String>,
    /// Figures of each.
    pub figures: Vec<ViewRow>,
    /// Time of a view.
    pub seconds: Option<f64>,
    /// Mean squared opacity where the masks show no head.
    pub outside: Option<f64>,
    /// Pieces of the surface, where one was made.
    pub pieces: Option<u64>,
    /// Whose masks the figures count inside: `capture`, `run` (made by the run itself, for a
    /// photograph at least) or `none`.
    pub masks: Option<String>,
    /// Why the figures or the surface are missing.
    pub problem: Option<String>,
}

impl Measured {
    fn mean(&self, measure: usize) -> Option<f64> {
        if measure == MEASURES.len() - 1 {
            return self.seconds;
        }
        let values: Vec<f64> = self.figures.iter().filter_map(|f| f[measure]).collect();
        (!values.is_empty()).then(|| values.iter().sum::<f64>() / values.len() as f64)
    }
}

/// A figure of the publication.
#[derive(Clone, Debug, PartialEq, Serialize)]
pub struct Published {
    /// The table's word.
    pub table: String,
    /// The row's.
    pub row: String,
    /// The measure's.
    pub measure: String,
    /// Its value.
    pub value: f64,
}

/// Reads `table,row,measure,value` lines; the first may name them.
///
/// # Errors
///
/// A line of another form, or with a word that is none of `rows` and [`MEASURES`].
pub fn read_published(text: &str, rows: &[ExperimentRow], file: &str) -> Result<Vec<Published>> {
    let mut out = Vec::new();
    for (i, line) in text.lines().enumerate() {
        let parts: Vec<&str> = line.split(',').map(str::trim).collect();
        if line.trim().is_empty() || (i == 0 && parts.first() == Some(&"table")) {
            continue;
        }
        let read = match parts[..] {
            [table, row, measure, value]
                if rows.iter().any(|r| r.table == table && r.row == row)
                    && MEASURES.iter().any(|m| m.0 == measure) =>
            {
                let finite = value.parse().ok().filter(|v: &f64| v.is_finite());
                finite.map(|value| Published {
                    table: table.into(),
                    row: row.into(),
                    measure: measure.into(),
                    value,
                })
            }
            _ => None,
        };
        out.push(read.ok_or_else(|| {
            Error::cannot(
                format!("`{file}`, line {}: `{line}` is no figure of a row", i + 1),
                "write `table,row,measure,value`, as in `tface,l2-reference,masked,30.1`",
            )
        })?);
    }
    Ok(out)
}

/// All that was measured.
#[derive(Clone, Debug, Serialize)]
pub struct Experiment {
    /// Scale of the training effort, relative to the published one.
    pub scale: f64,
    /// The requested tables: their word and heading.
    pub tables: Vec<(&'static str, &'static str)>,
    /// Their rows.
    pub rows: Vec<ExperimentRow>,
    /// The orderings that the paper reports.
    pub orderings: Vec<Ordering>,
    /// Names of the captures.
    pub captures: Vec<String>,
    /// `[rows][captures]`
    pub measured: Vec<Vec<Measured>>,
    /// The publication's figures, as far as they are known.
    pub published: Vec<Published>,
}

/// A mean with its 95 % interval over resamplings of the photographs.
#[derive(Clone, Copy, Debug, PartialEq, Serialize)]
pub struct Interval {
    /// Over captures, of the mean over photographs.
    pub mean: f64,
    /// The 2.5th percentile.
    pub low: f64,
    /// The 97.5th.
    pub high: f64,
}

/// Returns the mean over groups of the mean of each, and its interval by resampling within each
/// group (Efron 1979, percentiles). The draws are those of a fixed seed.
pub fn bootstrap(groups: &[Vec<f64>]) -> Option<Interval> {
    let groups: Vec<&Vec<f64>> = groups.iter().filter(|g| !g.is_empty()).collect();
    if groups.is_empty() {
        return None;
    }
    let over = |mean_of: &dyn Fn(usize, &[f64]) -> f64| {
        groups.iter().enumerate().map(|(i, g)| mean_of(i, g)).sum::<f64>() / groups.len() as f64
    };
    let mean = over(&|_, g| g.iter().sum::<f64>() / g.len() as f64);
    let mut drawn: Vec<f64> = (0..RESAMPLES)
        .map(|draw| {
            over(&|i, g| {
                let n = g.len() as u64;
                let pick = |k: u64| g[rng::below(1, (i as u64) << 32 | draw, k, n) as usize];
                (0..n).map(pick).sum::<f64>() / n as f64
            })
        })
        .collect();
    drawn.sort_by(f64::total_cmp);
    let at = |share: f64| drawn[((RESAMPLES - 1) as f64 * share).round() as usize];
    Some(Interval { mean, low: at(0.025), high: at(0.975) })
}

/// Whether an ordering holds.
#[derive(Clone, Copy, Debug, PartialEq, Eq, Serialize)]
#[serde(rename_all = "lowercase")]
pub enum Answer {
    /// It does.
    Yes,
    /// It does not.
    No,
    /// A row is missing.
    Unknown,
}

/// Whether an ordering holds, and the better row's figure less the worse one's.
pub type OrderingResult = (Answer, Option<f64>);

impl Experiment {
    fn index(&self, table: &str, row: &str) -> Option<usize> {
        self.rows.iter().position(|r| r.table == table && r.row == row)
    }

    /// Returns the mean over the captures of a row.
    fn mean(&self, row: usize, measure: usize) -> Option<f64> {
        let values: Vec<f64> = self.measured[row].iter().filter_map(|m| m.mean(measure)).collect();
        (!values.is_empty()).then(|| values.iter().sum::<f64>() / values.len() as f64)
    }

    /// Returns the differences of two rows by photograph: `[captures][photographs]`.
    fn differences(&self, row: usize, from: usize, measure: usize) -> Vec<Vec<f64>> {
        let pair = |(a, b): (&Measured, &Measured)| {
            let value = |m: &Measured, name: &String| {
                m.views.iter().position(|v| v == name).and_then(|i| m.figures[i][measure])
            };
            a.views.iter().filter_map(|v| Some(value(a, v)? - value(b, v)?)).collect()
        };
        self.measured[row].iter().zip(&self.measured[from]).map(pair).collect()
    }

    /// Returns whether an ordering holds, and by how much the better row is better: for each
    /// capture, and on average over those that have both rows.
    pub fn holds(&self, ordering: &Ordering) -> (Vec<OrderingResult>, OrderingResult) {
        let measure = MEASURES.iter().position(|m| m.0 == ordering.by).unwrap_or(0);
        let rows = (self.index(ordering.table, ordering.better), self.index(ordering.table, ordering.worse));
        let (Some(better), Some(worse)) = rows else {
            return (vec![(Answer::Unknown, None); self.captures.len()], (Answer::Unknown, None));
        };
        let slack = if ordering.or_equal { 0.05 } else { 0.0 };
        let judge = |a: Option<f64>, b: Option<f64>| match (a, b) {
            (Some(a), Some(b)) => (if a + slack > b { Answer::Yes } else { Answer::No }, Some(a - b)),
            _ => (Answer::Unknown, None),
        };
        let pairs = self.measured[better].iter().zip(&self.measured[worse]);
        let pairs: Vec<_> = pairs.map(|(a, b)| (a.mean(measure), b.mean(measure))).collect();
        let each = pairs.iter().map(|&(a, b)| judge(a, b)).collect();
        // a capture with one of the rows alone says which heads are hard, and nothing of the rows
        let both: Vec<(f64, f64)> = pairs.into_iter().filter_map(|(a, b)| a.zip(b)).collect();
        let mean = |of: fn(&(f64, f64)) -> f64| {
            (!both.is_empty()).then(|| both.iter().map(of).sum::<f64>() / both.len() as f64)
        };
        (each, judge(mean(|pair| pair.0), mean(|pair| pair.1)))
    }

    fn published(&self, row: &ExperimentRow, measure: &str) -> Option<f64> {
        let found =
            self.published.iter().find(|p| p.table == row.table && p.row == row.row && p.measure == measure);
        found.map(|p| p.value)
    }

    /// Returns whether, for at least one capture, a row was evaluated with masks that its own run
    /// made.
    fn judged_itself(&self, row: usize) -> bool {
        self.measured[row].iter().any(|m| m.masks.as_deref() == Some("run"))
    }

    /// Returns the title of a row, marked if it was evaluated with its run's own masks.
    fn title(&self, row: usize) -> String {
        let mark = if self.judged_itself(row) { OWN_MASKS } else { "" };
        format!("{}{mark}", self.rows[row].title)
    }
}

impl Experiment {
    /// Returns the measures that anything has, by their places in [`MEASURES`].
    fn measures(&self) -> Vec<usize> {
        (0..MEASURES.len())
            .filter(|&k| k == 0 || (0..self.rows.len()).any(|i| self.mean(i, k).is_some()))
            .collect()
    }

    /// Cells of a table: the heading, then a line for each row.
    fn cells(&self, table: &str) -> Vec<Vec<String>> {
        let mut heading = vec!["row".to_owned()];
        for (word, title, _) in self.measures().into_iter().map(|k| MEASURES[k]) {
            heading.push(title.into());
            if self.published.iter().any(|p| p.table == table && p.measure == word) {
                heading.push(format!("{title}, published"));
            }
        }
        heading.push("PSNR inside the mask more than the first row's, dB (95 %)".into());
        heading.push("mean opacity² where no head is".into());
        heading.push("pieces of the surface".into());
        let mut out = vec![heading];
        let dash = || "–".to_owned();
        let first = self.rows.iter().position(|r| r.table == table);
        for (i, row) in self.rows.iter().enumerate().filter(|(_, r)| r.table == table) {
            let mut line = vec![self.title(i)];
            for (k, (word, _, digits)) in self.measures().into_iter().map(|k| (k, MEASURES[k])) {
                line.push(self.mean(i, k).map_or_else(dash, |v| format!("{v:.digits$}")));
                if self.published.iter().any(|p| p.table == table && p.measure == word) {
                    line.push(self.published(row, word).map_or_else(dash, |v| format!("{v:.digits$}")));
                }
            }
            let more = first.filter(|f| *f != i).and_then(|f| bootstrap(&self.differences(i, f, 0)));
            line.push(
                more.map_or_else(dash, |m| format!("{:+.2} ({:+.2} to {:+.2})", m.mean, m.low, m.high)),
            );
            let outside: Vec<f64> = self.measured[i].iter().filter_map(|m| m.outside).collect();
            let mean = outside.iter().sum::<f64>() / outside.len().max(1) as f64;
            line.push(if outside.is_empty() { dash() } else { format!("{mean:.4}") });
            let pieces: Vec<String> =
                self.measured[i].iter().filter_map(|m| Some(m.pieces?.to_string())).collect();
            line.push(if pieces.is_empty() { dash() } else { pieces.join(", ") });
            out.push(line);
        }
        out
    }

    /// Returns the problems of single runs, a sentence for each capture and problem.
    fn problems(&self) -> Vec<String> {
        let mut out: Vec<((&str, &str), Vec<&str>)> = Vec::new();
        for (k, capture) in self.captures.iter().enumerate() {
            for (row, measured) in self.rows.iter().zip(&self.measured) {
                let Some(problem) = measured.get(k).and_then(|m| m.problem.as_deref()) else { continue };
                let what = (capture.as_str(), problem);
                let at = out.iter().position(|(w, _)| *w == what).unwrap_or(out.len());
                if at == out.len() {
                    out.push((what, Vec::new()));
                }
                if !out[at].1.contains(&row.run) {
                    out[at].1.push(row.run);
                }
            }
        }
        out.iter()
            .map(|((capture, problem), runs)| format!("{capture}, {}: {problem}", runs.join(", ")))
            .collect()
    }

    /// Returns the orderings as cells: the heading, then one line each.
    fn verdicts(&self) -> Vec<Vec<String>> {
        let mut out = vec![vec!["as expected, by PSNR inside the mask".to_owned()]];
        out[0].extend(self.captures.iter().cloned());
        out[0].push("on average".into());
        let word = |(holds, by): &OrderingResult| {
            let word = ["holds", "does not hold", "–"][*holds as usize];
            by.map_or(word.to_owned(), |by| format!("{word}, {by:+.2}"))
        };
        let measure = |o: &Ordering| MEASURES.iter().find(|m| m.0 == o.by).filter(|m| m.0 != "masked");
        for o in &self.orderings {
            let sign = if o.or_equal { "≥" } else { ">" };
            let (each, mean) = self.holds(o);
            let title = |row: &str| self.index(o.table, row).map_or(String::new(), |i| self.title(i));
            let claim = format!("{} {sign} {}", title(o.better), title(o.worse));
            let mut line = vec![measure(o).map_or(claim.clone(), |m| format!("{claim}, by {}", m.1))];
            line.extend(each.iter().map(word));
            line.push(word(&mean));
            out.push(line);
        }
        out
    }

    fn about(&self) -> String {
        let many = self.captures.len();
        let own = match (0..self.rows.len()).any(|i| self.judged_itself(i)) {
            true => {
                ", but in rows with †: for a capture at least, these are judged by masks that their own run made"
            }
            false => "",
        };
        let captures = if many == 1 { "capture" } else { "captures" };
        format!(
            "{many} {captures} ({}), scale {} of the published effort. PSNR and SSIM are means over held-out photographs as \
             they were taken, then over captures; masks are the captures' own{own}. Seconds a view of an ensemble are \
             those of its members and of the blend. A row that some captures lack is the mean of the others; \
             orderings on average are over the captures that have both rows. Intervals: {RESAMPLES} resamplings of the photographs.{}",
            self.captures.join(", "),
            self.scale,
            if self.published.is_empty() {
                " No published figures were given (`--published FILE`)."
            } else {
                ""
            }
        )
    }

    /// Returns the tables as Markdown.
    pub fn markdown(&self) -> String {
        let table = |cells: &[Vec<String>]| {
            let mut out = String::new();
            for (i, line) in cells.iter().enumerate() {
                let _ = writeln!(out, "| {} |", line.join(" | "));
                if i == 0 {
                    let _ = writeln!(out, "|{}", " --- |".repeat(line.len()));
                }
            }
            out
        };
        let mut out = format!("# The paper's experiment\n\n{}\n", self.about());
        for (word, title) in &self.tables {
            let _ = write!(out, "\n## {title}\n\n{}", table(&self.cells(word)));
        }
        let _ = write!(out, "\n## Orderings\n\n{}", table(&self.verdicts()));
        let problems = self.problems();
        if !problems.is_empty() {
            let _ = write!(out, "\n## What is missing\n\n");
            problems.iter().for_each(|p| out += &format!("- {p}\n"));
        }
        out
    }

    /// Returns all of it, as JSON, with intervals and verdicts.
    pub fn json(&self) -> String {
        let mut value = serde_json::json!(self);
        let rows: Vec<_> = (0..self.rows.len())
            .map(|i| {
                let means: serde_json::Map<String, serde_json::Value> = (MEASURES.iter().enumerate())
                    .map(|(k, m)| (m.0.to_owned(), serde_json::json!(self.mean(i, k))))
                    .collect();
                let first = self.rows.iter().position(|r| r.table == self.rows[i].table).unwrap_or(i);
                let more = bootstrap(&self.differences(i, first, 0));
                serde_json::json!({"table": self.rows[i].table, "row": self.rows[i].row, "mean": means,
                                   "masked_over_first": more})
            })
            .collect();
        let verdicts: Vec<_> = (self.orderings.iter())
            .map(|o| {
                let (captures, mean) = self.holds(o);
                let (words, more): (Vec<_>, Vec<_>) = captures.into_iter().unzip();
                serde_json::json!({"ordering": o, "captures": words, "average": mean.0,
                                   "more": more, "more_average": mean.1})
            })
            .collect();
        value["means"] = rows.into();
        value["verdicts"] = verdicts.into();
        format!("{value:#}\n")
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    const ROWS: [ExperimentRow; 2] = [
        ExperimentRow { table: "t", row: "a", title: "first <b>", run: "one", pictures: "tface" },
        ExperimentRow { table: "t", row: "b", title: "second", run: "two", pictures: "tface" },
    ];

    fn measured(values: &[f64]) -> Measured {
        Measured {
            views: (0..values.len()).map(|i| format!("v{i}")).collect(),
            figures: values.iter().map(|v| [Some(*v), None, None, None, None, None]).collect(),
            seconds: Some(1.5),
            ..Measured::default()
        }
    }

    fn experiment() -> Experiment {
        let ordering = Ordering { table: "t", better: "b", worse: "a", by: "masked", or_equal: false };
        Experiment {
            scale: 0.1,
            tables: vec![("t", "A table")],
            rows: ROWS.to_vec(),
            orderings: vec![ordering, Ordering { better: "a", worse: "b", or_equal: true, ..ordering }],
            captures: vec!["lps".into(), "x,y".into()],
            measured: vec![
                vec![measured(&[20.0, 22.0]), measured(&[30.0])],
                vec![measured(&[21.0, 23.5]), measured(&[29.99])],
            ],
            published: vec![Published {
                table: "t".into(),
                row: "b".into(),
                measure: "masked".into(),
                value: 27.5,
            }],
        }
    }

    #[test]
    fn orderings_are_judged_by_capture_and_on_average() {
        let e = experiment();
        let words = |e: &Experiment, i: usize| {
            let (each, mean) = e.holds(&e.orderings[i]);
            (each.into_iter().map(|v| v.0).collect::<Vec<_>>(), mean.0)
        };
        // 22.25 > 21, 29.99 < 30; 26.12 > 25.5
        assert_eq!(words(&e, 0), (vec![Answer::Yes, Answer::No], Answer::Yes));
        assert!((e.holds(&e.orderings[0]).0[0].1.unwrap() - 1.25).abs() < 1e-9);
        // a twentieth is as good
        assert_eq!(words(&e, 1), (vec![Answer::No, Answer::Yes], Answer::No));
        let mut missing = e.clone();
        missing.measured[1][0].figures.clear();
        missing.measured[1][0].views.clear();
        // on average over the second alone, where the first row is better: 29.99 < 30, though
        // 29.99 > 25.5
        assert_eq!(words(&missing, 0), (vec![Answer::Unknown, Answer::No], Answer::No));
        missing.measured[0][1].figures.clear();
        assert_eq!(words(&missing, 0), (vec![Answer::Unknown; 2], Answer::Unknown));
    }

    #[test]
    fn rows_judged_by_masks_of_their_own_run_are_marked() {
        let mut e = experiment();
        e.measured[0][0].masks = Some("capture".into());
        e.measured[0][1].masks = Some("none".into());
        assert!(!e.markdown().contains('†'));
        e.measured[1][1].masks = Some("run".into());
        let text = e.markdown();
        assert!(text.contains("| second † | 26.12 |") && text.contains("| first <b> | 25.50 |"), "{text}");
        assert!(text.contains("| second † > first <b> |") && text.contains("but in rows with †"), "{text}");
        let value: serde_json::Value = serde_json::from_str(&e.json()).unwrap();
        assert_eq!(
            (&value["measured"][1][1]["masks"], value["measured"][1][0]["masks"].is_null()),
            (&"run".into(), true)
        );
    }

    #[test]
    fn an_interval_holds_the_mean_and_is_the_same_every_time() {
        let values: Vec<f64> = (0..100).map(|i| f64::from(i % 10)).collect();
        let found = bootstrap(std::slice::from_ref(&values)).unwrap();
        // mean 4.5, standard error 2.87 / 10: 95 % within 0.56
        assert!((found.mean - 4.5).abs() < 1e-12 && (found.low - 3.94).abs() < 0.12, "{found:?}");
        assert!((found.high - 5.06).abs() < 0.12 && bootstrap(&[values]) == Some(found), "{found:?}");
        // captures count alike, however many photographs they have
        let two = bootstrap(&[vec![1.0], vec![3.0; 50], Vec::new()]).unwrap();
        assert_eq!(two, Interval { mean: 2.0, low: 2.0, high: 2.0 });
        assert_eq!(bootstrap(&[Vec::new()]), None);
    }

    #[test]
    fn tables_hold_means_differences_and_what_was_published() {
        let e = experiment();
        let text = e.markdown();
        // (21 + 30) / 2 and (22.25 + 29.99) / 2; on average (1.25 − 0.01) / 2 more
        assert!(
            text.contains("| first <b> | 25.50 | – |") && text.contains("| second | 26.12 | 27.50 |"),
            "{text}"
        );
        assert!(text.contains("+0.62 ("), "{text}");
        let verdict = "| second > first <b> | holds, +1.25 | does not hold, -0.01 | holds, +0.62 |";
        assert!(text.contains(verdict), "{text}");
        // LPIPS was not measured
        assert!(!text.contains("LPIPS"), "{text}");
        let value: serde_json::Value = serde_json::from_str(&e.json()).unwrap();
        assert!((value["means"][1]["mean"]["masked"].as_f64().unwrap() - 26.12).abs() < 1e-9);
        assert_eq!(value["verdicts"][0]["average"], "yes");
    }

    #[test]
    fn published_figures_are_read_or_named() {
        let read = |text: &str| read_published(text, &ROWS, "p.csv");
        let found = read("table,row,measure,value\nt,b,masked,27.5\n\n").unwrap();
        assert_eq!(found, experiment().published);
        for bad in ["t,b,masked", "t,c,masked,1", "t,b,psnr,1", "t,b,masked,nan"] {
            let e = read(bad).unwrap_err().to_string();
            assert!(e.contains("`p.csv`, line 1") && e.contains(bad), "{e}");
        }
    }
}
