//! `report.html`, from what lies in the run.

use super::{Line, PipelineError};
use crate::config::PictureFormat;
use crate::io::{self, Limits};
use crate::report::{self, Picture, Report, Row};
use crate::run::Done;

/// The stages that learn, and what of their `log.jsonl` is drawn.
const LEARNED: [(&str, &[&str]); 3] = [
    ("baseline", &["psnr", "samples"]),
    ("tface", &["psnr", "mask", "outside", "samples"]),
    ("iface", &["psnr", "eikonal", "inv_s"]),
];

impl Line<'_> {
    /// Writes `report.html`.
    pub fn report(&self, done: &[(&'static str, Done)]) -> Result<(), PipelineError> {
        let limits = Limits::default();
        let mut rows: Vec<Row> = Vec::new();
        for set in self.sets() {
            if self.config.render.format != PictureFormat::Png {
                continue; // browsers show no EXR
            }
            for shown in self.comparable(&set) {
                let name = &shown.view.name;
                if !rows.iter().any(|r| r.name == *name) {
                    let bytes = io::read_bytes(&shown.view.photo, &limits)?;
                    let photo = Picture { caption: "photograph".into(), bytes };
                    rows.push(Row { name: name.clone(), pictures: vec![photo] });
                }
                if let Some(row) = rows.iter_mut().find(|r| r.name == *name) {
                    let bytes = io::read_bytes(&shown.file, &limits)?;
                    row.pictures.push(Picture { caption: set.name.clone(), bytes });
                }
            }
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
        let summaries: Vec<_> = done.iter().map(|(name, d)| (name.to_string(), d.summary.clone())).collect();
        let html = report::html(&Report {
            title: self.capture.name.clone(),
            summaries,
            curves,
            rows,
            settings: self.config.to_toml(),
        });
        Ok(self.run.write("report.html", html.as_bytes())?)
    }
}
