//! Whether what is not read of a lens, since something else is, says the same.

use super::Object;
use serde_json::Value;
use std::collections::BTreeSet;

/// Keys of the focal length. A frame that has one of them takes none from the top, or its own angle
/// would be overruled by the whole file's focal length.
pub(super) const FOCAL_KEYS: [&str; 4] = ["fl_x", "fl_y", "camera_angle_x", "camera_angle_y"];

/// Values read of a lens, its file's included, to compare unread values with.
pub(super) struct Known<'a> {
    pub own: &'a Object,
    pub top: Option<&'a Object>,
}

/// Names of the values of a matrix of intrinsics.
pub(super) const PINHOLE: [&str; 4] = ["fl_x", "fl_y", "cx", "cy"];

/// Largest difference of focal lengths, relative, and of a principal point, in pixels: programs
/// count these from the center of a pixel or from its corner. Angles are rounded more.
const SAME_FOCAL: f64 = 1e-3;
const SAME_ANGLE: f64 = 1e-2;
const SAME_CENTER: f64 = 1.0;

impl Known<'_> {
    fn number(&self, key: &str) -> Option<f64> {
        let has_own = FOCAL_KEYS.iter().any(|key| self.own.contains_key(*key));
        let top = self.top.filter(|_| !(has_own && FOCAL_KEYS.contains(&key)));
        self.own.get(key).or_else(|| top?.get(key))?.as_f64()
    }

    /// Returns [`PINHOLE`] as far as it is known, and what would be taken for it.
    fn pinhole(&self) -> [Option<f64>; 4] {
        let [w, h] = ["w", "h"].map(|key| self.number(key));
        let of_angle = |key: &str, side: Option<f64>| Some(0.5 * side? / (0.5 * self.number(key)?).tan());
        let fx = self.number("fl_x").or_else(|| of_angle("camera_angle_x", w));
        let fy = self.number("fl_y").or_else(|| of_angle("camera_angle_y", h));
        let center = |key: &str, side: Option<f64>| self.number(key).or(side.map(|side| 0.5 * side));
        [fx.or(fy), fy.or(fx), center("cx", w), center("cy", h)]
    }

    /// Returns whether a value is that of [`PINHOLE`] number `k`, which is known.
    fn is_same(&self, k: usize, value: f64, known: f64) -> bool {
        let is_read = ["fl_x", "fl_y"].iter().any(|key| self.number(key).is_some());
        let most = match k {
            0 | 1 if is_read => SAME_FOCAL * known.abs(),
            0 | 1 => SAME_ANGLE * known.abs(),
            _ => SAME_CENTER,
        };
        (value.abs() - known.abs()).abs() <= most
    }

    /// Refuses a spelling beside the usual one that says something else. Which size is right,
    /// photographs tell.
    pub fn check_alias(
        &self,
        alias: &str,
        key: &str,
        value: &Value,
        doubts: &mut BTreeSet<String>,
    ) -> Result<(), String> {
        let Some((found, known)) = value.as_f64().zip(self.number(key)) else { return Ok(()) };
        let text = format!("`{alias}` is {found}, but `{key}` is {known}");
        match PINHOLE.iter().position(|name| *name == key) {
            Some(k) if !self.is_same(k, found, known) => Err(text + ": remove the one that is wrong"),
            None if found != known => {
                doubts.insert(text + ", which is read");
                Ok(())
            }
            _ => Ok(()),
        }
    }

    /// Refuses a matrix beside a focal length or an angle that says something else.
    pub fn check_matrix(
        &self,
        key: &str,
        found: [f64; 4],
        doubts: &mut BTreeSet<String>,
    ) -> Result<(), String> {
        for (k, (name, known)) in PINHOLE.into_iter().zip(self.pinhole()).enumerate() {
            let value = found[k];
            let Some(known) = known else {
                if k > 1 {
                    doubts.insert(format!(
                        "the principal point of `{key}` is not read, since a focal length or an angle is there; \
                         without `cx` and `cy` the middle is taken"
                    ));
                }
                continue;
            };
            if !self.is_same(k, value, known) {
                let says = match self.number(name) {
                    Some(_) => format!("`{name}` is {known}"),
                    None => format!("without `{name}` it would be {known:.2}"),
                };
                return Err(format!(
                    "`{key}` has {value} for `{name}`, but {says}: remove what is wrong, or write `fl_x`, \
                     `fl_y`, `cx` and `cy`"
                ));
            }
        }
        Ok(())
    }

    /// Refuses a list of four numbers beside a focal length or an angle if it says more than is
    /// read.
    pub fn check_list(&self, key: &str, four: [f64; 4]) -> Result<(), String> {
        let known = self.pinhole();
        let sides = [self.number("w"), self.number("h")];
        let is_known = |v: f64| {
            known.into_iter().enumerate().any(|(k, known)| {
                let share = sides[k % 2].map_or(v, |side| v * side);
                known.is_some_and(|known| self.is_same(k, v, known) || self.is_same(k, share, known))
            })
        };
        // without a size, an angle tells where the middle is
        let half = self.number("camera_angle_x").map(|angle| (0.5 * angle).tan() * four[0]);
        let is_middle = known[0].is_none() && half.is_some_and(|half| (half - four[2]).abs() <= SAME_CENTER);
        if is_middle || four.into_iter().all(is_known) {
            return Ok(());
        }
        Err(format!(
            "`{key}` is a list of four numbers, whose order is not known, and they are not those of the focal \
             length, the angle and the principal point beside it: write `fl_x`, `fl_y`, `cx` and `cy` (in \
             pixels), and remove it"
        ))
    }
}

/// Returns a list of four numbers.
pub(super) fn numbers(value: &Value) -> Option<[f64; 4]> {
    let list: Option<Vec<f64>> = value.as_array()?.iter().take(5).map(Value::as_f64).collect();
    list?.try_into().ok()
}
