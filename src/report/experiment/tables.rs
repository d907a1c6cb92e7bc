//! The tables of an experiment as people and programs read them: Markdown and JSON.

use super::{DRAWS, Experiment, MEASURES, Ordering, Verdict, bootstrap};
use std::fmt::Write;

impl Experiment {
    /// The measures that anything has, by their places in [`MEASURES`].
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

    /// What is wrong with single runs, a sentence for each capture and problem.
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

    /// The orderings as cells: the heading, then one line each.
    fn verdicts(&self) -> Vec<Vec<String>> {
        let mut out = vec![vec!["as expected, by PSNR inside the mask".to_owned()]];
        out[0].extend(self.captures.iter().cloned());
        out[0].push("on average".into());
        let word = |(holds, by): &Verdict| {
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
             orderings on average are over the captures that have both rows. Intervals: {DRAWS} resamplings of the photographs.{}",
            self.captures.join(", "),
            self.scale,
            if self.published.is_empty() {
                " No published figures were given (`--published FILE`)."
            } else {
                ""
            }
        )
    }

    /// As Markdown.
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

    /// All of it, as JSON, with intervals and verdicts.
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
