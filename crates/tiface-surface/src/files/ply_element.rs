//! Elements and properties of PLY, and the names that programs give to what they hold.

/// A type of numbers.
#[derive(Clone, Copy, PartialEq)]
pub(super) enum Scalar {
    I8,
    U8,
    I16,
    U16,
    I32,
    U32,
    F32,
    F64,
}

impl Scalar {
    pub fn named(name: &str) -> Option<Scalar> {
        Some(match name {
            "char" | "int8" => Scalar::I8,
            "uchar" | "uint8" => Scalar::U8,
            "short" | "int16" => Scalar::I16,
            "ushort" | "uint16" => Scalar::U16,
            "int" | "int32" => Scalar::I32,
            "uint" | "uint32" => Scalar::U32,
            "float" | "float32" => Scalar::F32,
            "double" | "float64" => Scalar::F64,
            _ => return None,
        })
    }

    pub fn size(self) -> usize {
        match self {
            Scalar::I8 | Scalar::U8 => 1,
            Scalar::I16 | Scalar::U16 => 2,
            Scalar::I32 | Scalar::U32 | Scalar::F32 => 4,
            Scalar::F64 => 8,
        }
    }

    /// Returns the value of white, for colors.
    pub fn white(self) -> f64 {
        match self {
            Scalar::U8 => 255.0,
            Scalar::U16 => 65535.0,
            _ => 1.0,
        }
    }
}

/// A number, or a list of them, of each row of an element.
pub(super) struct Property {
    pub name: String,
    pub item: Scalar,
    /// The type of a list's length.
    pub length: Option<Scalar>,
}

/// A table of the file.
pub(super) struct Element {
    pub name: String,
    pub count: usize,
    pub properties: Vec<Property>,
}

impl Property {
    /// Returns the color that a number packs, `0xAARRGGBB` with an alpha of 0 or 255; that of a
    /// float by its bits, as PCL does, with an alpha of 0.
    pub fn unpacked(&self, value: f64) -> Option<[f32; 3]> {
        let code = match self.item {
            Scalar::U32 => Some(value as u32),
            Scalar::I32 => Some(value as i32 as u32),
            Scalar::F32 => Some((value as f32).to_bits()).filter(|bits| *bits < 1 << 24),
            _ => None,
        };
        match code?.to_be_bytes() {
            [0 | 255, r, g, b] => Some([r, g, b].map(|c| f32::from(c) / 255.0)),
            // bytes in another order
            _ => None,
        }
    }

    /// Returns a color's value, 0..=1 if its type counts to white.
    pub fn coded(&self, value: f64) -> f32 {
        (value / self.item.white()) as f32
    }
}

impl Element {
    /// Returns where properties of these names stand, in any letters, if all of them do; lists are
    /// none.
    pub fn slots<const N: usize>(&self, names: [&str; N]) -> Option<[usize; N]> {
        let is_it = |p: &Property, name: &str| p.name.eq_ignore_ascii_case(name) && p.length.is_none();
        let slot = |name: &str| self.properties.iter().position(|p| is_it(p, name));
        let mut slots = [0; N];
        for (slot_of, name) in slots.iter_mut().zip(names) {
            *slot_of = slot(name)?;
        }
        Some(slots)
    }

    /// Returns where red, green and blue stand, under any of their names.
    pub fn color(&self) -> Option<[usize; 3]> {
        let spellings = [
            ["red", "green", "blue"],
            ["diffuse_red", "diffuse_green", "diffuse_blue"],
            ["r", "g", "b"],
            ["ambient_red", "ambient_green", "ambient_blue"],
        ];
        spellings.into_iter().find_map(|names| self.slots(names))
    }

    /// Returns the color in these properties of a row, coded; `None` if it is not finite.
    pub fn coded_color(&self, slots: [usize; 3], row: &[f64]) -> Option<[f32; 3]> {
        let coded = slots.map(|k| self.properties[k].coded(row[k]));
        coded.iter().all(|c| c.is_finite()).then_some(coded)
    }

    /// Returns the property that holds whole colors, as PCL packs them, if there are no others.
    pub fn packed_color(&self) -> Option<usize> {
        let found = ["rgb", "rgba"].into_iter().find_map(|name| self.slots([name]));
        found.map(|[k]| k).filter(|_| self.color().is_none())
    }

    /// Returns the name of a property that seems to hold colors.
    pub fn like_a_color(&self) -> Option<&str> {
        let is_one = |name: &str| {
            let name = name.to_ascii_lowercase();
            let whole = ["red", "rgb", "rgba", "intensity", "luminance", "gray", "grey"];
            ["color", "colour", "f_dc"].iter().any(|part| name.contains(part))
                || name.split(|c: char| !c.is_ascii_alphanumeric()).any(|word| whole.contains(&word))
        };
        self.properties.iter().map(|p| p.name.as_str()).find(|name| is_one(name))
    }
}
