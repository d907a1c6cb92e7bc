//! Line charts over training steps or another quantity, as SVG inside a page.

use super::text::{csv_text, escape};
use serde_json::Value;
use std::fmt::Write;

/// A figure over steps.
#[derive(Clone, Debug, PartialEq)]
pub struct Curve {
    /// Its name.
    pub name: String,
    /// Step and value, in order.
    pub points: Vec<(f64, f64)>,
}

/// Curves of one figure that are drawn together.
#[derive(Clone, Debug, PartialEq)]
pub struct Chart {
    /// Quantity that is drawn.
    pub title: String,
    /// One line each, the first in the page's own color.
    pub curves: Vec<Curve>,
}

/// Returns the named figures of a `log.jsonl` over its steps, one chart a figure and one curve for
/// each field that a stage learns. Lines that are not JSON (cut short by a crash) are passed over;
/// a step logged twice, before and after an interruption, counts the second time.
pub fn charts(stage: &str, log: &str, names: &[&str]) -> Vec<Chart> {
    let title = |name: &&str| Chart { title: format!("{stage} {name}"), curves: Vec::new() };
    let mut charts: Vec<Chart> = names.iter().map(title).collect();
    for line in log.lines() {
        let Ok(Value::Object(entry)) = serde_json::from_str(line) else { continue };
        let Some(step) = entry.get("step").and_then(Value::as_f64) else { continue };
        let field = entry.get("field").and_then(Value::as_u64);
        let own = field.map_or(String::new(), |f| format!("field {f}"));
        for (chart, name) in charts.iter_mut().zip(names) {
            let Some(value) = entry.get(*name).and_then(Value::as_f64) else { continue };
            // steps that were repeated after an interruption replace the earlier ones
            chart.curves.iter_mut().for_each(|c| c.points.retain(|(s, _)| *s < step));
            match chart.curves.iter_mut().find(|c| c.name == own) {
                Some(curve) => curve.points.push((step, value)),
                None => chart.curves.push(Curve { name: own.clone(), points: vec![(step, value)] }),
            }
        }
    }
    for chart in &mut charts {
        chart.curves.retain(|c| c.points.len() > 1);
        // fields are learned one after the other: each begins at its own first step
        let firsts: Vec<f64> = chart.curves.iter().map(|c| c.points[0].0).collect();
        for (curve, first) in chart.curves.iter_mut().zip(firsts).skip(1) {
            curve.points.iter_mut().for_each(|(s, _)| *s -= first - 1.0);
        }
    }
    charts.retain(|c| !c.curves.is_empty());
    charts
}

/// Returns all points of curves as comma-separated values (RFC 4180), a heading first.
pub fn curves_csv(charts: &[Chart]) -> String {
    let mut csv = "figure,curve,step,value\n".to_string();
    for chart in charts {
        for Curve { name, points } in &chart.curves {
            let [figure, name] = [&chart.title, name].map(|text| csv_text(text));
            points.iter().for_each(|(step, value)| csv += &format!("{figure},{name},{step},{value}\n"));
        }
    }
    csv
}

/// Sides of the drawing, and where its axes lie.
const WIDTH: f64 = 420.0;
const HEIGHT: f64 = 170.0;
const LEFT: f64 = 44.0;
const BOTTOM: f64 = 18.0;
/// Maximum number of points of a line: more cannot be distinguished.
const MAX_POINTS: usize = 240;
/// A figure over more than this many times its least value is drawn by its logarithm.
const MIN_LOG_RANGE: f64 = 30.0;

impl Chart {
    /// Returns the drawing with its title and legend: a part of a page.
    pub fn html(&self) -> String {
        let points = || self.curves.iter().flat_map(|c| &c.points).filter(|p| p.1.is_finite());
        let span = |values: &mut dyn Iterator<Item = f64>| {
            values.fold((f64::INFINITY, f64::NEG_INFINITY), |(lo, hi), v| (lo.min(v), hi.max(v)))
        };
        let (x0, x1) = span(&mut points().map(|p| p.0));
        let (low, high) = span(&mut points().map(|p| p.1));
        let by_log = low > 0.0 && high / low > MIN_LOG_RANGE;
        let scaled = |v: f64| if by_log { v.log10() } else { v };
        let (y0, y1) = (scaled(low), scaled(high));
        let share = |v: f64, lo: f64, hi: f64| if hi > lo { (v - lo) / (hi - lo) } else { 0.5 };
        let across = |x: f64| LEFT + (WIDTH - LEFT) * share(x, x0, x1);
        let down = |y: f64| 6.0 + (HEIGHT - BOTTOM - 6.0) * (1.0 - share(scaled(y), y0, y1));
        let last = |c: &Curve| c.points.iter().rev().map(|p| p.1).find(|v| v.is_finite()).unwrap_or(0.0);
        let end = short(self.curves.first().map_or(0.0, last));
        let mut out = format!(
            "<figure class=\"chart\"><figcaption><b>{}</b> {}</figcaption><svg viewBox=\"0 0 {WIDTH} {HEIGHT}\" \
             role=\"img\" aria-label=\"{}, {} at the end\">",
            escape(&self.title),
            end,
            escape(&self.title),
            end,
        );
        for y in ticks(y0, y1, by_log && y1 - y0 > 2.0) {
            let y = if by_log { 10f64.powf(y) } else { y };
            let at = down(y);
            let _ = write!(
                out,
                "<line class=\"grid\" x1=\"{LEFT}\" x2=\"{WIDTH}\" y1=\"{at:.1}\" y2=\"{at:.1}\"/>\
                 <text x=\"{:.0}\" y=\"{:.1}\" text-anchor=\"end\">{}</text>",
                LEFT - 6.0,
                at + 4.0,
                short(y)
            );
        }
        for x in ticks(x0, x1, false) {
            let anchor = if across(x) > WIDTH - 20.0 { "end" } else { "middle" };
            let _ = write!(
                out,
                "<text x=\"{:.1}\" y=\"{HEIGHT}\" text-anchor=\"{anchor}\">{}</text>",
                across(x),
                short(x)
            );
        }
        for (k, curve) in self.curves.iter().enumerate() {
            let step = curve.points.len().div_ceil(MAX_POINTS);
            let kept = curve.points.iter().enumerate();
            let kept =
                kept.filter(|(i, p)| (i % step == 0 || i + 1 == curve.points.len()) && p.1.is_finite());
            let line: Vec<String> =
                kept.map(|(_, &(x, y))| format!("{:.1},{:.1}", across(x), down(y))).collect();
            let _ = write!(out, "<polyline class=\"line-{}\" points=\"{}\"/>", k % 4, line.join(" "));
        }
        out += "</svg>";
        if self.curves.len() > 1 {
            let ends = self.curves.iter().map(|c| format!("{} {}", escape(&c.name), short(last(c))));
            let _ = write!(out, "<figcaption>{}</figcaption>", ends.collect::<Vec<_>>().join(" · "));
        }
        out + "</figure>"
    }
}

/// Returns two to five round numbers within a range: 1, 2 or 5 times a power of ten apart; whole
/// numbers only if `whole`.
fn ticks(low: f64, high: f64, whole: bool) -> Vec<f64> {
    if high <= low || !(high - low).is_finite() {
        return if low.is_finite() { vec![low] } else { Vec::new() };
    }
    let rough = (high - low) / 4.0;
    let power = 10f64.powf(rough.log10().floor());
    let step = [1.0, 2.0, 5.0, 10.0].into_iter().map(|k| k * power).find(|s| *s >= rough);
    let step = step.unwrap_or(rough).max(if whole { 1.0 } else { 0.0 });
    let first = (low / step).ceil() as i64;
    (first..=first + 5).map(|i| i as f64 * step).filter(|v| *v <= high * (1.0 + 1e-9)).collect()
}

/// Three or four digits: `34.95`, `0.013`, `1500`, `1.2e-5`.
fn short(value: f64) -> String {
    match value.abs() {
        0.0 => "0".into(),
        1e6.. | ..1e-4 => format!("{value:.1e}"),
        100.0.. => format!("{value:.0}"),
        1.0.. => format!("{value:.2}").trim_end_matches('0').trim_end_matches('.').into(),
        _ => format!("{value:.4}").trim_end_matches('0').into(),
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_log_written_through_an_interruption_gives_one_line() {
        let log = r#"{"step":1,"psnr":10.0}
{"step":9,"psnr":20.0}
{"st
{"step":5,"psnr":15.0}
"#;
        let found = charts("iface", log, &["psnr", "absent"]);
        let curve = Curve { name: String::new(), points: vec![(1.0, 10.0), (5.0, 15.0)] };
        assert_eq!(found, [Chart { title: "iface psnr".into(), curves: vec![curve] }]);
        assert_eq!(
            curves_csv(&found),
            "figure,curve,step,value\n\"iface psnr\",\"\",1,10\n\"iface psnr\",\"\",5,15\n"
        );
    }

    #[test]
    fn several_fields_are_several_lines_from_the_same_step() {
        let log = r#"{"step":1,"psnr":10.0,"field":1}
{"step":4,"psnr":20.0,"field":1}
{"step":5,"psnr":11.0,"field":2}
{"step":8,"psnr":21.0,"field":2}
"#;
        let found = charts("tface", log, &["psnr"]);
        let points: Vec<_> = found[0].curves.iter().map(|c| c.points.clone()).collect();
        assert_eq!(points, [vec![(1.0, 10.0), (4.0, 20.0)], vec![(1.0, 11.0), (4.0, 21.0)]]);
        let html = found[0].html();
        assert!(html.contains("field 1 20 · field 2 21") && html.matches("<polyline").count() == 2);
    }

    #[test]
    fn ticks_are_round_and_numbers_short() {
        assert_eq!(ticks(0.0, 1500.0, false), [0.0, 500.0, 1000.0, 1500.0]);
        assert_eq!(ticks(12.0, 35.0, false), [20.0, 30.0]);
        assert_eq!(
            (ticks(3.0, 3.0, false), ticks(f64::INFINITY, f64::NEG_INFINITY, false)),
            (vec![3.0], vec![])
        );
        assert_eq!(
            [34.95, 0.0132, 1500.0, 1.24e-5, 2.0, 30.0].map(short),
            ["34.95", "0.0132", "1500", "1.2e-5", "2", "30"]
        );
        // one step, no height, no range: still a drawing
        let flat = Chart {
            title: "<x>".into(),
            curves: vec![Curve { name: "a".into(), points: vec![(1.0, 2.0), (1.0, f64::NAN)] }],
        };
        let html = flat.html();
        assert!(html.contains("&lt;x&gt;") && !html.contains("NaN") && !html.contains("<x>"), "{html}");
    }
}
