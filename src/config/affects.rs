//! What the value of a key changes: a column of every row of a table.

use super::{Config, Stage};

/// A result that keys affect: that of a stage, or a part of it that later stages read.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum Product {
    /// The stage `mask`: masks, poses, exposures, glare and the box.
    Masks,
    /// The stage `baseline`.
    Baseline,
    /// The stage `tface`.
    Tface,
    /// The stage `iface`.
    Iface,
    /// The extracted surface, from which the head mesh is made.
    Surface,
    /// The head mesh as views show it, however its files are written.
    Head,
    /// The stage `mesh`: surface, head mesh and files.
    Files,
    /// Views of any cameras.
    Views,
    /// The stage `render`: views of the held-out cameras.
    HeldOut,
    /// Views along a camera path.
    Path,
    /// The stage `ensemble`.
    Blend,
    /// The stage `metrics`.
    Metrics,
}

impl Product {
    /// Returns everything that a stage makes for the evaluation.
    pub fn of(stage: Stage) -> Product {
        match stage {
            Stage::Mask => Product::Masks,
            Stage::Baseline => Product::Baseline,
            Stage::Tface => Product::Tface,
            Stage::Iface => Product::Iface,
            Stage::Mesh => Product::Files,
            Stage::Render => Product::HeldOut,
            Stage::Ensemble => Product::Blend,
            Stage::Metrics => Product::Metrics,
        }
    }

    /// Returns the stage that makes it.
    pub fn stage(self) -> Stage {
        match self {
            Product::Masks => Stage::Mask,
            Product::Baseline => Stage::Baseline,
            Product::Tface => Stage::Tface,
            Product::Iface => Stage::Iface,
            Product::Surface | Product::Head | Product::Files => Stage::Mesh,
            Product::Views | Product::HeldOut | Product::Path => Stage::Render,
            Product::Blend => Stage::Ensemble,
            Product::Metrics => Stage::Metrics,
        }
    }

    /// Returns whether the product changes with another one of its stage, or is that one.
    fn shows(self, other: Product) -> bool {
        let parts: &[Product] = match self {
            Product::Files => &[Product::Surface, Product::Head],
            Product::Head => &[Product::Surface],
            Product::HeldOut | Product::Path => &[Product::Views],
            _ => &[],
        };
        self == other || parts.contains(&other)
    }
}

/// A product that a key affects, directly and not through another product.
#[derive(Clone, Copy, Debug)]
pub struct Effect {
    /// The product; what shows it is affected too.
    pub on: Product,
    /// Whether the key affects it beside these settings.
    pub when: fn(&Config) -> bool,
}

impl Effect {
    /// Returns whether this is an effect on a product.
    pub(super) fn reaches(&self, product: Product, config: &Config) -> bool {
        product.shows(self.on) && (self.when)(config)
    }
}

/// The effects of a key, as the column of its row states them: `nothing`, or products, each with a
/// condition if it has one.
macro_rules! affects {
    (nothing) => {
        &[]
    };
    ($($product:ident $(if $when:expr)?),+) => {
        &[$($crate::config::Effect {
            on: $crate::config::Product::$product,
            when: $crate::config::affects::when!($($when)?),
        }),+]
    };
}

/// A condition, or none.
macro_rules! when {
    () => {
        |_| true
    };
    ($when:expr) => {
        $when
    };
}

pub(super) use {affects, when};
