//! `report.html`, from what lies in the run.

use super::{Line, STAGES};
use crate::Result;
use crate::config::{PictureFormat, called};
use crate::io::{self, Limits};
use crate::report::{self, Picture, Report, Row};
use crate::run::read_record;
use serde_json::Value;

/// The stages that learn, and what of their `log.jsonl` is drawn.
const LEARNED: [(&str, &[&str]); 3] = [
    ("baseline", &["psnr", "samples"]),
    ("tface", &["psnr", "mask", "outside", "samples"]),
    ("iface", &["psnr", "eikonal", "inv_s"]),
];

/// A page with more bytes of pictures than this is no pleasure in a browser; further views are only
/// counted.
const MOST: usize = 48 << 20;

impl Line<'_> {
    /// Writes `report.html`, of every stage that is done; without the photographs it stays as it is.
    pub fn report(&self) -> Result<()> {
        if self.gone.is_some() {
            return Ok(());
        }
        let limits = Limits::default();
        let sets = match self.config.render.format {
            PictureFormat::Png => self.sets(),
            PictureFormat::Exr => Vec::new(), // browsers show none
        };
        let shown: Vec<_> = sets.iter().map(|set| (set.name.clone(), self.comparable(set))).collect();
        let (mut rows, mut bytes, mut left_out) = (Vec::new(), 0, 0);
        let masks = self.run.path("mask").join(super::mask::SHEET);
        let mut sheet = String::new();
        if io::is_file(&masks) {
            sheet = String::from_utf8_lossy(&io::read_bytes(&masks, &limits)?).into_owned();
            bytes += sheet.len();
        }
        for view in &self.capture.views {
            let mut files = Vec::new();
            for (name, set) in &shown {
                let file = set.iter().find(|s| s.view.name == view.name).map(|s| s.file.as_path());
                files.extend(file.map(|file| (name.as_str(), file)));
            }
            if files.is_empty() {
                continue;
            }
            if bytes > MOST {
                left_out += 1;
                continue;
            }
            let mut pictures = Vec::new();
            for (caption, file) in [("photograph", view.photo.as_path())].into_iter().chain(files) {
                let picture = io::read_bytes(file, &limits)?;
                bytes += picture.len();
                pictures.push(Picture { caption: called(caption), bytes: picture });
            }
            rows.push(Row { name: view.name.clone(), pictures });
        }
        let mut curves = Vec::new();
        for (stage, names) in LEARNED {
            let log = self.run.path(stage).join("log.jsonl");
            if io::is_file(&log) {
                let text = io::read_bytes(&log, &limits)?;
                let found = report::curves(&String::from_utf8_lossy(&text), names).into_iter();
                curves.extend(found.map(|c| report::Curve { name: format!("{stage} {}", c.name), ..c }));
            }
        }
        let named = |name: &str, summary: Value| match summary {
            Value::Object(sets) if name == "metrics" => {
                sets.iter().map(|(set, figures)| (called(set), figures.clone())).collect()
            }
            other => other,
        };
        let figures = |name: &&str| {
            let record = read_record(&self.run.path(name)).ok()??;
            Some((name.to_string(), named(name, record.summary)))
        };
        let summaries: Vec<_> = STAGES.iter().filter_map(figures).collect();
        let html = report::html(&Report {
            title: self.capture.name.clone(),
            summaries,
            masks: crate::mask::sheet::part(&sheet).unwrap_or_default().into(),
            curves,
            rows,
            left_out,
            settings: self.config.to_toml(),
        });
        Ok(self.run.write("report.html", html.as_bytes())?)
    }
}
