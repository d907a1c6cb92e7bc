//! `[ensemble]`: how several views of one camera become one.

use super::render::Method;
use super::table::table;

table! {
    /// Members and weights of the blend.
    pub struct EnsembleConfig;
    keys {
        /// Methods to blend, a list of baseline, tface, volume (I-Face), raycast (I-Face's mesh),
        /// plain and textured (head.glb); empty: no blend.
        #[flag("members", Text("LIST"), ["ensemble"],
            "Methods to blend, separated by commas: baseline, tface, volume (I-Face), raycast (I-Face's \
             mesh), plain, textured and raster (head.glb)")]
        members: Vec<Method> [Blend]
            => vec![Method::Tface, Method::Raycast],
            vec![Method::Tface, Method::Raycast],
            vec![Method::Baseline, Method::Tface, Method::Volume];
        /// Weights of the members, in their order, with sum 1; empty: fit them on capture.tiles.
        #[flag("weights", Text("LIST"), ["ensemble"],
            "Weights of the methods, in that order, with sum 1 [default: fitted]")]
        weights: Vec<f64>, 0.0..=1.0 [Blend] => Vec::new(), Vec::new(), vec![0.1, 0.6, 0.3];
        /// Cut members that were trained without masks to the head: true or false.
        cut: bool [Blend] => true, true, false;
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::config::{Config, Sources};

    fn set(set: &[&str]) -> Config {
        let set = set.iter().map(|s| s.to_string()).collect();
        Config::resolve(&Sources { set, ..Sources::default() }).unwrap()
    }

    #[test]
    fn weights_are_fitted_unless_they_are_given_and_iface_is_a_word_for_volume() {
        let c = set(&[]);
        assert_eq!(c.ensemble.members, [Method::Tface, Method::Raycast]);
        assert!(c.ensemble.weights.is_empty() && c.capture.tiles > 0.0);
        assert!(!c.render.method.contains(&Method::Baseline));
        let c = set(&["preset=paper"]);
        assert_eq!(c.ensemble.members, [Method::Baseline, Method::Tface, Method::Volume]);
        assert_eq!((c.ensemble.weights.iter().sum::<f64>(), c.capture.tiles), (1.0, 0.0));
        assert!(c.render.method.contains(&Method::Baseline));
        let c = set(&["ensemble.members=tface,iface", "ensemble.weights=1,0"]).ensemble;
        assert_eq!((c.members[1], c.weights.as_slice()), (Method::Volume, &[1.0, 0.0][..]));
        assert!(set(&["preset=paper", "ensemble.weights="]).ensemble.weights.is_empty());
    }
}
