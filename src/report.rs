//! `report.html`: one file to look at, nothing loaded from elsewhere. What it looks like stands in `report/page.html`.

use crate::{Error, ErrorKind, Result};
use base64::prelude::{BASE64_STANDARD, Engine};
use minijinja::Environment;
use serde::Serialize;
use serde_json::Value;

/// What a report shows.
#[derive(Clone, Debug, Default, Serialize)]
pub struct Report {
    /// Of the page: the capture's name.
    pub title: String,
    /// Stage and the rows of its figures ([`leaves`]).
    pub summaries: Vec<(String, Vec<(String, String)>)>,
    /// How near each kind of picture is to the photographs: the heading, then a row each; may be empty.
    pub quality: Vec<Vec<String>>,
    /// The masks over their photographs: a part of a page, already escaped.
    pub masks: String,
    /// Lines over training steps.
    pub curves: Vec<Curve>,
    /// Photographs with what was rendered for them.
    pub rows: Vec<ViewRow>,
    /// Views that found no room.
    pub left_out: usize,
    /// The configuration as TOML.
    pub settings: String,
}

/// A figure over steps.
#[derive(Clone, Debug, PartialEq, Serialize)]
#[serde(into = "Chart")]
pub struct Curve {
    /// Its name.
    pub name: String,
    /// Step and value, in order.
    pub points: Vec<(f64, f64)>,
}

/// The pictures of one view: the photograph and what was made for it.
#[derive(Clone, Debug, Serialize)]
pub struct ViewRow {
    /// The view's name.
    pub name: String,
    /// The photograph first.
    pub pictures: Vec<CaptionedPicture>,
}

/// A picture inside the page.
#[derive(Clone, Debug, Serialize)]
pub struct CaptionedPicture {
    caption: String,
    url: String,
}

impl CaptionedPicture {
    /// Of the bytes of a PNG or JPEG file.
    pub fn new(caption: String, file: &[u8]) -> CaptionedPicture {
        let kind = if file.starts_with(&[0xFF, 0xD8]) { "jpeg" } else { "png" };
        CaptionedPicture { caption, url: format!("data:image/{kind};base64,{}", base64(file)) }
    }
}

/// The named figures of a `log.jsonl` over its steps. Lines that are not JSON (cut short by a crash)
/// are passed over; a step logged twice, before and after an interruption, counts the second time.
pub fn curves(log: &str, names: &[&str]) -> Vec<Curve> {
    let mut curves: Vec<Curve> =
        names.iter().map(|n| Curve { name: n.to_string(), points: Vec::new() }).collect();
    for line in log.lines() {
        let Ok(Value::Object(entry)) = serde_json::from_str(line) else { continue };
        let Some(step) = entry.get("step").and_then(Value::as_f64) else { continue };
        for curve in &mut curves {
            if let Some(value) = entry.get(&curve.name).and_then(Value::as_f64) {
                while curve.points.last().is_some_and(|(s, _)| *s >= step) {
                    curve.points.pop();
                }
                curve.points.push((step, value));
            }
        }
    }
    curves.retain(|c| c.points.len() > 1);
    curves
}

/// Returns the page.
pub fn html(report: &Report) -> Result<String> {
    let mut pages = Environment::new();
    pages.set_trim_blocks(true);
    let page = pages.template_from_named_str("page.html", include_str!("report/page.html"));
    page.and_then(|page| page.render(report)).map_err(|e| Error::new(ErrorKind::Bug, e))
}

/// Leaves of a JSON value with dotted names, as a person reads them; lists in one row.
pub fn leaves(value: &Value) -> Vec<(String, String)> {
    let Value::Object(map) = value else {
        let text = match value {
            Value::Number(n) if n.is_f64() => format!("{:.4}", n.as_f64().unwrap_or(f64::NAN)),
            Value::Null => "–".into(),
            Value::String(s) => s.clone(),
            other => other.to_string(),
        };
        return vec![(String::new(), text)];
    };
    let inner = |(key, value): (&String, &Value)| {
        let name = |inner: String| if inner.is_empty() { key.clone() } else { format!("{key}.{inner}") };
        leaves(value).into_iter().map(|(inner, text)| (name(inner), text)).collect::<Vec<_>>()
    };
    map.iter().flat_map(inner).collect()
}

/// A curve as the page draws it, 420 by 160, with its range in words.
#[derive(Serialize)]
struct Chart {
    name: String,
    points: String,
    lowest: String,
    highest: String,
    first: String,
    last: String,
}

impl From<Curve> for Chart {
    fn from(Curve { name, points }: Curve) -> Chart {
        let span = |values: &mut dyn Iterator<Item = f64>| {
            values.fold((f64::INFINITY, f64::NEG_INFINITY), |(lo, hi), v| (lo.min(v), hi.max(v)))
        };
        let (x0, x1) = span(&mut points.iter().map(|p| p.0));
        let (y0, y1) = span(&mut points.iter().map(|p| p.1));
        let scale = |v: f64, lo: f64, hi: f64| if hi > lo { (v - lo) / (hi - lo) } else { 0.5 };
        let point = |(x, y): &(f64, f64)| {
            format!("{:.1},{:.1}", 420.0 * scale(*x, x0, x1), 160.0 * (1.0 - scale(*y, y0, y1)))
        };
        Chart {
            name,
            points: points.iter().map(point).collect::<Vec<_>>().join(" "),
            lowest: format!("{y0:.4}"),
            highest: format!("{y1:.4}"),
            first: format!("{x0:.0}"),
            last: format!("{x1:.0}"),
        }
    }
}

/// Text for between and inside the tags of a page.
pub(crate) fn escape(text: &str) -> String {
    text.replace('&', "&amp;").replace('<', "&lt;").replace('>', "&gt;").replace('"', "&quot;")
}

/// RFC 4648, with padding.
pub(crate) fn base64(bytes: &[u8]) -> String {
    BASE64_STANDARD.encode(bytes)
}

#[cfg(test)]
mod tests {
    use super::*;
    use serde_json::json;

    #[test]
    fn a_log_written_through_an_interruption_gives_one_line() {
        let log = r#"{"step":1,"psnr":10.0}
{"step":9,"psnr":20.0}
{"st
{"step":5,"psnr":15.0}
"#;
        let found = curves(log, &["psnr", "absent"]);
        assert_eq!(found, [Curve { name: "psnr".into(), points: vec![(1.0, 10.0), (5.0, 15.0)] }]);
    }

    #[test]
    fn the_page_holds_everything_and_escapes_names() {
        let page = html(&Report {
            title: "<head>".into(),
            summaries: vec![(
                "mesh".into(),
                leaves(&json!({"closed": true, "report": {"volume": 0.25}, "p": null})),
            )],
            quality: [["", "edge"], ["head & neck", "21.02"]].map(|r| r.map(String::from).to_vec()).to_vec(),
            masks: "<figure>mask</figure>".into(),
            curves: vec![Curve { name: "psnr".into(), points: vec![(0.0, 1.0), (2.0, 3.0)] }],
            rows: vec![ViewRow {
                name: "012".into(),
                pictures: vec![
                    CaptionedPicture::new("photograph".into(), &[0xFF, 0xD8, 1]),
                    CaptionedPicture::new("ensemble".into(), &[1]),
                ],
            }],
            left_out: 3,
            settings: "[mesh]".into(),
        })
        .unwrap();
        assert!(page.contains("<h1>&lt;head&gt;</h1>") && !page.contains("http"));
        assert!(page.contains("<td>report.volume</td><td>0.2500</td>"));
        assert!(page.contains("<tr><th></th><th>edge</th></tr>"), "{page}");
        assert!(page.contains("<tr><td>head &amp; neck</td><td>21.02</td></tr>"), "{page}");
        assert!(page.contains("points=\"0.0,160.0 420.0,0.0\""), "{page}");
        assert!(page.contains("<td>p</td><td>–</td>") && page.contains("<pre>[mesh]</pre>"));
        assert!(page.contains("<p>3 more views lie in"));
        assert!(page.contains("<h2>Masks</h2>\n<figure>mask</figure>"));
        assert!(page.contains("<h3>012</h3>") && page.contains("<figcaption>ensemble</figcaption>"));
        assert!(page.contains("data:image/jpeg;base64,/9gB") && page.contains("data:image/png;base64,AQ=="));
    }
}
