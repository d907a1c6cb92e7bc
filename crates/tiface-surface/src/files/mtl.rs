//! Reading of `.mtl`: the materials beside an OBJ, as far as they color it.
//!
//! Keys are known in any letters, names of pictures with blanks, in quotes and behind options. A
//! picture stands in `map_Kd`; programs that write none may have it as `map_Ke` or `map_Ka`.

use super::beside::unquoted;
use super::source::{ReadOptions, Source, line_end, without_byte_order_mark};
use std::path::Path;
use tiface_base::Result;

/// Materials of a file; more are an attack.
const MAX_MATERIALS: usize = 1 << 16;

/// Color of the faces of one material.
#[derive(Clone, Debug, Default, PartialEq)]
pub struct Material {
    /// Its name, as `usemtl` writes it.
    pub name: String,
    /// `Kd`, taken as sRGB-coded.
    pub color: Option<[f32; 3]>,
    /// The picture of `map_Kd`, as it is written, without quotes and options.
    pub picture: Option<String>,
    /// A picture of another key, and that key.
    pub stand_in: Option<(&'static str, String)>,
    /// The keys that make it transparent.
    pub transparent: Option<&'static str>,
    /// Whether `d` is written, which decides over `Tr`.
    has_d: bool,
}

/// Reads the materials in the bytes of a `.mtl` file. `path` is for messages only.
///
/// # Errors
///
/// Fails if a picture has options that move, scale or brighten it, or if there are more than 65,536
/// materials.
pub fn materials_of_mtl(bytes: &[u8], path: &Path) -> Result<Vec<Material>> {
    let source = Source { path, format: "MTL", options: &ReadOptions::DEFAULT };
    if bytes.starts_with(&[0xff, 0xfe]) || bytes.starts_with(&[0xfe, 0xff]) {
        return Err(source.unsupported("byte 0", "text in UTF-16").with_hint("save it as UTF-8"));
    }
    let mut all: Vec<Material> = Vec::new();
    let (text, end) = (without_byte_order_mark(bytes), line_end(bytes));
    for (number, line) in (1..).zip(text.split(|&b| b == end)) {
        let line = String::from_utf8_lossy(line.trim_ascii());
        let (key, value) = line.split_once(char::is_whitespace).unwrap_or((&line, ""));
        let (key, value) = (key.to_ascii_lowercase(), value.trim());
        if key.is_empty() || key.starts_with('#') {
            continue;
        }
        let at = format!("line {number}");
        // a file may begin without `newmtl`
        if key == "newmtl" || all.is_empty() {
            if all.len() == MAX_MATERIALS {
                return Err(source.broken(at, format!("more than {MAX_MATERIALS} materials")));
            }
            let name = if key == "newmtl" { unquoted(value) } else { "" };
            all.push(Material { name: name.into(), ..Material::default() });
        }
        let Some(material) = all.last_mut() else { continue };
        let picture = || match behind_options(value) {
            Ok(name) => Ok(Some(unquoted(name).to_owned()).filter(|name| !name.is_empty())),
            Err(()) => {
                let shown: String = value.chars().take(60).collect();
                Err(source.unsupported(&at, format!("a texture with options (`{shown}`)")))
            }
        };
        match key.as_str() {
            "kd" => material.color = numbers(value),
            "map_kd" => material.picture = picture()?.or(material.picture.take()),
            "map_ke" | "map_ka" => {
                let key = if key == "map_ke" { "map_Ke" } else { "map_Ka" };
                // options of a picture that may not be shown are no error
                if let (None, Ok(Some(name))) = (&material.stand_in, picture()) {
                    material.stand_in = Some((key, name));
                }
            }
            "map_d" => material.transparent = Some("map_d"),
            "d" => {
                material.has_d = true;
                let is_clear = value.parse::<f32>().is_ok_and(|d| d < 1.0);
                material.transparent =
                    material.transparent.filter(|k| *k != "Tr").or(is_clear.then_some("d"));
            }
            "tr" if !material.has_d => {
                let is_clear = value.parse::<f32>().is_ok_and(|t| t > 0.0);
                material.transparent = material.transparent.or(is_clear.then_some("Tr"));
            }
            _ => {}
        }
    }
    Ok(all)
}

/// Returns three finite numbers, or one for all three.
fn numbers(value: &str) -> Option<[f32; 3]> {
    let found: Option<Vec<f32>> = value
        .split_ascii_whitespace()
        .take_while(|word| !word.starts_with('#'))
        .map(|word| word.parse::<f32>().ok().filter(|v| v.is_finite()))
        .collect();
    match found?[..] {
        [gray] => Some([gray; 3]),
        [r, g, b, ..] => Some([r, g, b]),
        _ => None,
    }
}

/// Returns what follows the options before the name of a picture; an error if one changes where or
/// how it is seen.
fn behind_options(text: &str) -> std::result::Result<&str, ()> {
    let first_word = |text: &'_ str| -> usize { text.find(char::is_whitespace).unwrap_or(text.len()) };
    let mut rest = text.trim();
    loop {
        let (option, mut behind) = rest.split_at(first_word(rest));
        let option = option.to_ascii_lowercase();
        // most words that follow, and the number that changes nothing
        let (most, neutral): (usize, &[f64]) = match option.as_str() {
            "-blendu" | "-blendv" | "-cc" | "-clamp" | "-texres" | "-boost" | "-bm" | "-imfchan"
            | "-type" => (1, &[]),
            "-mm" => (2, &[0.0, 1.0]),
            "-o" | "-t" => (3, &[0.0; 3]),
            "-s" => (3, &[1.0; 3]),
            _ => return Ok(rest),
        };
        for k in 0..most {
            behind = behind.trim_start();
            let (word, after) = behind.split_at(first_word(behind));
            match (word.parse::<f64>(), neutral.get(k)) {
                (Ok(value), Some(expected)) if value != *expected => return Err(()),
                (Err(_), Some(_)) => break, // fewer numbers, then the name
                _ => behind = after,
            }
        }
        rest = behind.trim_start();
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    fn only(text: &str) -> Material {
        materials_of_mtl(text.as_bytes(), Path::new("a.mtl")).unwrap().pop().unwrap()
    }

    #[test]
    fn names_of_pictures_lose_quotes_and_options_but_keep_their_blanks() {
        for (line, name) in [
            ("map_Kd ./my head.png\r", "./my head.png"),
            ("map_Kd \"my head.png\"", "my head.png"),
            ("map_kd -s 1 1 1 -o 0 0 0 -clamp on my head.png", "my head.png"),
            ("MAP_KD -s 1 \"a.png\"", "a.png"),
            ("\tmap_Kd\tC:\\x y\\a.png", "C:\\x y\\a.png"),
            ("map_Kd -bm 0.5 -mm 0 1 -imfchan r a.png", "a.png"),
            ("map_Kd -head.png", "-head.png"),
        ] {
            assert_eq!(only(&format!("newmtl a\n{line}\n")).picture.as_deref(), Some(name), "{line}");
        }
        assert_eq!(only("newmtl a\nmap_Kdx a.png").picture, None);
        assert_eq!(only("newmtl a\nmap_Kd\n").picture, None);
        for moved in ["-s 2 2 2", "-o 0.5 0 0", "-s 1 2", "-mm 0 2"] {
            let text = format!("newmtl a\nmap_Kd {moved} a.png");
            let error = materials_of_mtl(text.as_bytes(), Path::new("a.mtl")).unwrap_err();
            let expected = format!("`a.mtl`, line 2: a texture with options (`{moved} a.png`)");
            assert!(error.to_string().contains(&expected), "{error}");
        }
    }

    #[test]
    fn colors_and_what_is_transparent_are_read_by_material() {
        let text = "\u{feff}newmtl skin 1\nKd 0.8 0.4 0.2\nd 0.5\nnewmtl \"eyes\"\nKd 0.5\nmap_Ke e.png\nTr 0\nd 1\n";
        let all = materials_of_mtl(text.as_bytes(), Path::new("a")).unwrap();
        assert_eq!((all[0].name.as_str(), all[1].name.as_str()), ("skin 1", "eyes"));
        assert_eq!((all[0].color, all[1].color), (Some([0.8, 0.4, 0.2]), Some([0.5; 3])));
        assert_eq!((all[0].transparent, all[1].transparent), (Some("d"), None));
        assert_eq!(all[1].stand_in, Some(("map_Ke", "e.png".into())));
        assert_eq!(only("newmtl a\nTr 0.25\n").transparent, Some("Tr"));
        // `d` decides, wherever it stands
        assert_eq!(only("newmtl a\nTr 1\nd 1\n").transparent, None);
        assert_eq!(only("newmtl a\nd 1\nTr 1\n").transparent, None);
        assert_eq!(only("newmtl a\nKd spectral a.rfl\n").color, None);
    }
}
