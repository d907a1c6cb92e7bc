//! `report.html`: one file to look at, nothing loaded from elsewhere.

use serde_json::Value;
use std::fmt::Write;

/// What a report shows.
#[derive(Clone, Debug, Default)]
pub struct Report {
    /// Of the page: the capture's name.
    pub title: String,
    /// Stage and its figures.
    pub summaries: Vec<(String, Value)>,
    /// The masks over their photographs: a part of a page, already escaped.
    pub masks: String,
    /// Lines over training steps.
    pub curves: Vec<Curve>,
    /// Photographs with what was rendered for them.
    pub rows: Vec<Row>,
    /// Views that found no room.
    pub left_out: usize,
    /// The configuration as TOML.
    pub settings: String,
}

/// A figure over steps.
#[derive(Clone, Debug, PartialEq)]
pub struct Curve {
    /// Its name.
    pub name: String,
    /// Step and value, in order.
    pub points: Vec<(f64, f64)>,
}

/// The pictures of one view: the photograph and what was made for it.
#[derive(Clone, Debug)]
pub struct Row {
    /// The view's name.
    pub name: String,
    /// The photograph first.
    pub pictures: Vec<Picture>,
}

/// A picture as the bytes of a PNG or JPEG file.
#[derive(Clone, Debug)]
pub struct Picture {
    /// Below it.
    pub caption: String,
    /// The file.
    pub bytes: Vec<u8>,
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

/// The page.
pub fn html(report: &Report) -> String {
    let mut out = String::new();
    let title = escape(&report.title);
    let _ = write!(
        out,
        "<!doctype html>\n<html lang=\"en\"><head><meta charset=\"utf-8\">\n\
         <meta name=\"viewport\" content=\"width=device-width, initial-scale=1\">\n<title>{title} · tiface</title>\n\
         <style>body{{font:15px/1.5 system-ui,sans-serif;margin:2rem auto;max-width:70rem;padding:0 1rem}}\
         figure{{display:inline-block;margin:.5rem}}.row{{overflow-x:auto;white-space:nowrap}}img{{height:20rem;background:#000}}\
         table{{border-collapse:collapse}}td{{padding:.1rem 1rem .1rem 0}}pre{{overflow:auto}}\
         svg{{border:1px solid #8884}}</style></head><body>\n<h1>{title}</h1>\n"
    );
    for (stage, figures) in &report.summaries {
        let _ = writeln!(out, "<h2>{}</h2>\n<table>", escape(stage));
        let mut rows = Vec::new();
        flatten(figures, "", &mut rows);
        for (name, value) in rows {
            let _ = writeln!(out, "<tr><td>{}</td><td>{}</td></tr>", escape(&name), escape(&value));
        }
        out.push_str("</table>\n");
    }
    if !report.masks.is_empty() {
        let _ = writeln!(out, "<h2>Masks</h2>\n{}", report.masks);
    }
    if !report.curves.is_empty() {
        out.push_str("<h2>Training</h2>\n");
        report.curves.iter().for_each(|c| out.push_str(&svg(c)));
    }
    if !report.rows.is_empty() {
        out.push_str("<h2>Photographs and renders</h2>\n");
    }
    for row in &report.rows {
        let _ = writeln!(out, "<h3>{}</h3>\n<div class=\"row\">", escape(&row.name));
        for picture in &row.pictures {
            let (caption, url) = (escape(&picture.caption), data_url(&picture.bytes));
            let _ = writeln!(
                out,
                "<figure><img alt=\"{caption}\" src=\"{url}\"><figcaption>{caption}</figcaption></figure>"
            );
        }
        out.push_str("</div>\n");
    }
    if report.left_out > 0 {
        let _ = writeln!(out, "<p>{} more views lie in <code>render/</code>.</p>", report.left_out);
    }
    let _ = writeln!(out, "<h2>Settings</h2>\n<pre>{}</pre>\n</body></html>", escape(&report.settings));
    out
}

/// Leaves of a JSON value with dotted names; lists in one row.
fn flatten(value: &Value, name: &str, rows: &mut Vec<(String, String)>) {
    match value {
        Value::Object(map) => {
            for (key, inner) in map {
                let full = if name.is_empty() { key.clone() } else { format!("{name}.{key}") };
                flatten(inner, &full, rows);
            }
        }
        Value::Number(n) if n.is_f64() => {
            rows.push((name.into(), format!("{:.4}", n.as_f64().unwrap_or(f64::NAN))));
        }
        Value::Null => rows.push((name.into(), "–".into())),
        Value::String(s) => rows.push((name.into(), s.clone())),
        other => rows.push((name.into(), other.to_string())),
    }
}

/// A line chart with its range in words.
fn svg(curve: &Curve) -> String {
    const W: f64 = 420.0;
    const H: f64 = 160.0;
    let span = |values: &mut dyn Iterator<Item = f64>| {
        values.fold((f64::INFINITY, f64::NEG_INFINITY), |(lo, hi), v| (lo.min(v), hi.max(v)))
    };
    let (x0, x1) = span(&mut curve.points.iter().map(|p| p.0));
    let (y0, y1) = span(&mut curve.points.iter().map(|p| p.1));
    let scale = |v: f64, lo: f64, hi: f64| if hi > lo { (v - lo) / (hi - lo) } else { 0.5 };
    let path: Vec<String> = curve
        .points
        .iter()
        .map(|(x, y)| format!("{:.1},{:.1}", W * scale(*x, x0, x1), H * (1.0 - scale(*y, y0, y1))))
        .collect();
    format!(
        "<figure><svg viewBox=\"0 0 {W} {H}\" width=\"{W}\" height=\"{H}\"><polyline fill=\"none\" \
         stroke=\"#26a\" stroke-width=\"1.5\" points=\"{}\"/></svg><figcaption>{}: {:.4} to {:.4} over steps \
         {x0:.0} to {x1:.0}</figcaption></figure>\n",
        path.join(" "),
        escape(&curve.name),
        y0,
        y1
    )
}

/// Text for between and inside the tags of a page.
pub(crate) fn escape(text: &str) -> String {
    text.replace('&', "&amp;").replace('<', "&lt;").replace('>', "&gt;").replace('"', "&quot;")
}

fn data_url(bytes: &[u8]) -> String {
    let kind = if bytes.starts_with(&[0xFF, 0xD8]) { "jpeg" } else { "png" };
    format!("data:image/{kind};base64,{}", base64(bytes))
}

/// RFC 4648, with padding.
pub(crate) fn base64(bytes: &[u8]) -> String {
    const LETTERS: &[u8; 64] = b"ABCDEFGHIJKLMNOPQRSTUVWXYZabcdefghijklmnopqrstuvwxyz0123456789+/";
    let mut out = String::with_capacity(bytes.len().div_ceil(3) * 4);
    for chunk in bytes.chunks(3) {
        let word = chunk.iter().fold(0u32, |w, b| w << 8 | *b as u32) << (8 * (3 - chunk.len()));
        for k in 0..4 {
            let letter = LETTERS[(word >> (18 - 6 * k) & 63) as usize] as char;
            out.push(if k > chunk.len() { '=' } else { letter });
        }
    }
    out
}

#[cfg(test)]
mod tests {
    use super::*;
    use serde_json::json;

    #[test]
    fn base64_of_the_rfc() {
        // RFC 4648, section 10
        for (plain, coded) in
            [("", ""), ("f", "Zg=="), ("fo", "Zm8="), ("foo", "Zm9v"), ("foobar", "Zm9vYmFy")]
        {
            assert_eq!(base64(plain.as_bytes()), coded);
        }
    }

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
            summaries: vec![("mesh".into(), json!({"closed": true, "report": {"volume": 0.25}, "p": null}))],
            masks: "<figure>mask</figure>".into(),
            curves: vec![Curve { name: "psnr".into(), points: vec![(0.0, 1.0), (2.0, 3.0)] }],
            rows: vec![Row {
                name: "012".into(),
                pictures: vec![
                    Picture { caption: "photograph".into(), bytes: vec![0xFF, 0xD8, 1] },
                    Picture { caption: "ensemble".into(), bytes: vec![1] },
                ],
            }],
            left_out: 3,
            settings: "[mesh]".into(),
        });
        assert!(page.contains("<h1>&lt;head&gt;</h1>") && !page.contains("http"));
        assert!(page.contains("<td>report.volume</td><td>0.2500</td>"));
        assert!(page.contains("points=\"0.0,160.0 420.0,0.0\""), "{page}");
        assert!(page.contains("<p>3 more views lie in"));
        assert!(page.contains("<h2>Masks</h2>\n<figure>mask</figure>"));
        assert!(page.contains("<h3>012</h3>") && page.contains("<figcaption>ensemble</figcaption>"));
        assert!(page.contains("data:image/jpeg;base64,/9gB") && page.contains("data:image/png;base64,AQ=="));
    }
}
