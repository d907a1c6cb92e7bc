//! Several moments of a moving head in one capture: VHAP, GaussianAvatars, D-NeRF, HyperNeRF, INSTA
//! and NerFace write them, and one shape learned from all of them is none of them.
//!
//! Frames of several moments are refused where cameras stand still from one moment to another, for
//! half of the frames or more: nothing but the head can have moved then. Where every photograph is
//! from another place, as in a video of a head that holds still, the times of frames prove nothing,
//! and there is only a warning.

use super::Object;
use crate::folder::shortened;
use crate::frame::Listing;
use crate::masks::few;
use glam::{DMat3, DVec3};
use serde_json::Value;
use std::collections::{BTreeMap, HashMap, HashSet};
use std::hash::{DefaultHasher, Hash, Hasher};
use tiface_base::Error;

/// Keys that tell one moment from another, the best first, and whether each is worth a word where
/// cameras move: all photographs have times.
pub(super) const KEYS: [(&str, bool); 14] = [
    ("timestep_index", true),
    ("timestep_id", true),
    ("timestep", true),
    ("time_step", true),
    ("time_index", true),
    ("time_id", true),
    ("frame_time", true),
    ("time", true),
    ("warp_id", true),
    ("flame_param_path", true),
    ("exp_path", true),
    ("mesh_path", true),
    ("expression", true),
    ("timestamp", false),
];

/// How far a camera may be off, as a share of the cameras' extent and of a rotation's entries, to
/// stand where another does.
const SAME_PLACE: f64 = 1e-3;

/// The moments of all frames of a capture.
#[derive(Default)]
pub(super) struct Moments {
    frames: Vec<Moment>,
    /// By [`hash`], how a message shows a moment, and how Python writes it, if that is plain.
    shown: HashMap<u64, (String, Option<String>)>,
}

struct Moment {
    /// By number in [`KEYS`].
    values: Vec<(usize, u64)>,
    rotation: DMat3,
    position: DVec3,
}

fn hash(value: &Value) -> u64 {
    let mut hasher = DefaultHasher::new();
    value.to_string().hash(&mut hasher);
    hasher.finish()
}

impl Moments {
    /// Adds a frame.
    pub fn add(&mut self, own: &Object, (rotation, position): (DMat3, DVec3)) {
        let given = |key: &str| own.get(key).filter(|value| !value.is_null());
        let of = |(k, (key, _)): (usize, &(&str, bool))| Some((k, given(key)?));
        let values = KEYS.iter().enumerate().filter_map(of).map(|(k, value)| {
            let moment = hash(value);
            self.shown.entry(moment).or_insert_with(|| show(value));
            (k, moment)
        });
        let values = values.collect();
        self.frames.push(Moment { values, rotation, position });
    }

    /// Says if there are several moments: a problem where they are seen by the same cameras.
    pub fn report(&self, files: &[&str], listing: &mut Listing) {
        for (k, (key, is_telling)) in KEYS.iter().enumerate() {
            let of = |frame: &&Moment| frame.values.iter().any(|(key, _)| *key == k);
            let frames: Vec<&Moment> = self.frames.iter().filter(of).collect();
            let moment = |frame: &Moment| frame.values.iter().find(|(key, _)| *key == k).map_or(0, |v| v.1);
            let mut counts: HashMap<u64, usize> = HashMap::new();
            let mut order = Vec::new();
            for frame in &frames {
                let count = counts.entry(moment(frame)).or_insert(0);
                if *count == 0 {
                    order.push(moment(frame));
                }
                *count += 1;
            }
            if order.len() < 2 {
                continue;
            }
            if 2 * still_count(&frames, moment) >= frames.len() {
                // the first of those with the most photographs
                let most = order.iter().rev().max_by_key(|moment| counts[*moment]).unwrap_or(&order[0]);
                listing.problems.push(self.refuse(files, key, &order, (*most, counts[most])));
                return;
            }
            if *is_telling {
                listing.warnings.push(format!(
                    "`{}`: the photographs are of {} moments (`{key}`), from places that differ; if the head \
                     moved meanwhile, one shape is learned from all of them",
                    files.join("`, `"),
                    order.len()
                ));
                return;
            }
        }
    }

    fn refuse(&self, files: &[&str], key: &str, order: &[u64], (most, photographs): (u64, usize)) -> Error {
        let shown = few(order.iter().map(|moment| self.shown[moment].0.as_str()));
        let (n, (name, python)) = (order.len(), &self.shown[&most]);
        let message = format!(
            "`{}` holds {n} moments (`{key}`: {shown}), seen by cameras that stand still: a head that moved \
             between them would be learned as one shape",
            files.join("`, `")
        );
        let way = match python {
            Some(value) => format!("in a copy of the capture: `{}`", keep(files, key, value)),
            None => format!("keep only the frames of one `{key}`"),
        };
        let hint = format!(
            "take one moment, such as `{name}` with {photographs} photographs: {way}; if the head held \
             still, remove `{key}` from the frames"
        );
        Error::cannot(message, hint)
    }
}

/// Returns the command that leaves only the frames of one moment in some files, and no file without
/// frames.
fn keep(files: &[&str], key: &str, value: &str) -> String {
    let files: Vec<String> = files.iter().map(|file| format!("'{file}'")).collect();
    format!(
        "python3 -c \"import json, os; [open(p, 'w').write(json.dumps(dict(t, frames=f))) if f else \
         os.remove(p) for p in [{}] for t in [json.load(open(p))] for f in [[f for f in t['frames'] if \
         f.get('{key}') == {value}]]]\"",
        files.join(", ")
    )
}

/// Returns a moment for a message, and as Python writes it if it is a number or a plain word, which
/// is safe in a command.
fn show(value: &Value) -> (String, Option<String>) {
    let is_plain = |text: &str| {
        text.len() <= 40
            && text.chars().all(|c| c.is_ascii_alphanumeric() || ['_', '-', '.', '/'].contains(&c))
    };
    match value {
        Value::Number(number) => (number.to_string(), Some(number.to_string())),
        Value::String(text) if is_plain(text) => (text.clone(), Some(format!("'{text}'"))),
        Value::String(text) => (shortened(text), None),
        value => (shortened(&value.to_string()), None),
    }
}

/// Returns the number of frames whose camera stands in the same place at another moment.
fn still_count(frames: &[&Moment], moment: impl Fn(&Moment) -> u64) -> usize {
    let mean = frames.iter().map(|f| f.position).sum::<DVec3>() / frames.len() as f64;
    let extent = frames.iter().map(|f| f.position.distance(mean)).fold(0.0, f64::max);
    let step = SAME_PLACE * if extent > 1e-9 * (1.0 + mean.length()) { extent } else { 1.0 + mean.length() };
    let place = |frame: &Moment| -> [i64; 12] {
        let mut rounded = [0; 12];
        let turn = frame.rotation.to_cols_array().map(|v| v / SAME_PLACE);
        let numbers = turn.into_iter().chain((frame.position - mean).to_array().map(|v| v / step));
        rounded.iter_mut().zip(numbers).for_each(|(to, v)| *to = v.round() as i64);
        rounded
    };
    let mut places: BTreeMap<[i64; 12], (HashSet<u64>, usize)> = BTreeMap::new();
    for frame in frames {
        let (moments, count) = places.entry(place(frame)).or_default();
        moments.insert(moment(frame));
        *count += 1;
    }
    places.values().filter(|(moments, _)| moments.len() > 1).map(|(_, count)| count).sum()
}

#[cfg(test)]
mod tests {
    use super::*;
    use serde_json::json;

    fn at(angle: f64) -> (DMat3, DVec3) {
        let rotation = DMat3::from_rotation_y(angle);
        (rotation, 3.0 * rotation.z_axis)
    }

    fn reported(frames: &[(Value, f64)]) -> Listing {
        let mut moments = Moments::default();
        frames.iter().for_each(|(own, angle)| moments.add(own.as_object().unwrap(), at(*angle)));
        let mut listing = Listing::default();
        moments.report(&["transforms.json"], &mut listing);
        listing
    }

    #[test]
    fn moments_that_standing_cameras_see_are_refused_with_a_command() {
        for (key, values) in [
            ("timestep_index", [json!(0), json!(1), json!(2)]),
            ("timestep_id", [json!("000"), json!("001"), json!("002")]),
            ("time", [json!(0.0), json!(0.5), json!(1.0)]),
            ("timestamp", [json!(1.0), json!(2.0), json!(3.0)]),
        ] {
            let frame = |i: usize| (json!({ key: values[i / 4] }), 0.2 * (i % 4) as f64);
            let listing = reported(&(0..12).map(frame).collect::<Vec<_>>());
            let [problem] = &listing.problems[..] else { panic!("{key}") };
            let text = problem.to_string();
            assert!(text.contains("holds 3 moments") && text.contains(key), "{text}");
            let python = values[0].to_string().replace('"', "'");
            assert!(problem.hint().contains(&format!("f.get('{key}') == {python}]")), "{}", problem.hint());
        }
    }

    #[test]
    fn one_moment_is_no_word_and_moving_cameras_a_warning() {
        let frame = |key: &str, value: Value, i: usize| (json!({ key: value }), 0.1 * i as f64);
        let same = reported(&(0..9).map(|i| frame("timestep_index", json!(4), i)).collect::<Vec<_>>());
        let none = reported(&(0..9).map(|i| frame("x", json!(i), i)).collect::<Vec<_>>());
        let dated = reported(&(0..9).map(|i| frame("timestamp", json!(i), i)).collect::<Vec<_>>());
        for listing in [same, none, dated] {
            assert!(listing.problems.is_empty() && listing.warnings.is_empty(), "{listing:?}");
        }
        let video = reported(&(0..9).map(|i| frame("time", json!(i), i)).collect::<Vec<_>>());
        assert!(video.problems.is_empty() && video.warnings[0].contains("9 moments (`time`)"), "{video:?}");
    }

    #[test]
    fn a_value_that_is_no_plain_word_is_in_no_command() {
        let hostile = json!("0'; rm -rf ~; '");
        let frames = [(json!({ "time_id": hostile }), 0.0), (json!({ "time_id": 1 }), 0.0)];
        let hint = reported(&frames).problems[0].hint().to_string();
        assert!(
            hint.contains("keep only the frames of one `time_id`") && !hint.contains("python3"),
            "{hint}"
        );
    }
}
