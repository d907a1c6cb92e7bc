//! A small picture in the terminal, as far as the terminal says that it can show one: by the protocols of Kitty and
//! iTerm2, as Sixel, else as half-blocks of 24-bit color.

use crate::Result;
use crate::image::{CODED, Photo, average, over_black};
use crate::io;
use crate::pipeline::PreviewPicture;
use crate::report::base64;
use std::fmt::Write;
use std::path::Path;

/// Pixels along each side for terminals that show pixels.
const SIDE: u32 = 384;

/// Columns of half-blocks.
const COLUMNS: u32 = 48;

/// Kitty takes so many characters at once.
const PIECE: usize = 4096;

/// Steps of red, green and blue in a Sixel.
const STEPS: u32 = 6;

#[derive(Clone, Copy, Debug, PartialEq)]
enum Protocol {
    Kitty,
    Iterm,
    Sixel,
    Blocks,
}

/// What a terminal with these variables can show.
fn protocol(variable: impl Fn(&str) -> String) -> Protocol {
    let (term, program) = (variable("TERM"), variable("TERM_PROGRAM"));
    if !variable("KITTY_WINDOW_ID").is_empty() || term.contains("kitty") || term.contains("ghostty") {
        Protocol::Kitty
    } else if ["iTerm.app", "WezTerm"].contains(&&*program) || variable("LC_TERMINAL") == "iTerm2" {
        Protocol::Iterm
    } else if ["sixel", "foot", "mlterm", "contour"].iter().any(|known| term.contains(known)) {
        Protocol::Sixel
    } else {
        Protocol::Blocks
    }
}

/// The characters that show a picture.
pub(super) fn shown(picture: &PreviewPicture) -> Result<String> {
    let protocol = protocol(|name| std::env::var(name).unwrap_or_default());
    Ok(match protocol {
        Protocol::Blocks => blocks(&smaller(picture, COLUMNS)),
        Protocol::Sixel => sixel(&smaller(picture, SIDE)),
        Protocol::Kitty | Protocol::Iterm => {
            let PreviewPicture { width, height, rgba } = smaller(picture, SIDE);
            // over black: what is behind is unknown
            let rgb = rgba.iter().map(|&p| over_black(p)).collect();
            let photo = Photo { width, height, rgb, alpha: None };
            let png = io::png_bytes(&photo, Path::new("preview"))?;
            let coded = base64(&png);
            if protocol == Protocol::Iterm {
                format!("\x1b]1337;File=inline=1;size={}:{coded}\x07\n", png.len())
            } else {
                kitty(&coded)
            }
        }
    })
}

/// At most so wide; each pixel the mean of those it covers.
fn smaller(picture: &PreviewPicture, most: u32) -> PreviewPicture {
    let width = picture.width.min(most);
    let height = (u64::from(picture.height) * u64::from(width) / u64::from(picture.width)).max(1) as u32;
    // what is transparent has no color that counts
    let over = |&p: &[u8; 4]| {
        let [r, g, b] = over_black(p);
        [r, g, b, p[3]]
    };
    let bytes: Vec<u8> = picture.rgba.iter().flat_map(over).collect();
    let small = average(&bytes, 4, (picture.width, picture.height), (width, height), CODED);
    let straight = |&[r, g, b, a]: &[u8; 4]| {
        let [r, g, b] = [r, g, b].map(|v| (u32::from(v) * 255 / u32::from(a.max(1))).min(255) as u8);
        [r, g, b, a]
    };
    let rgba = small.as_chunks::<4>().0.iter().map(straight).collect();
    PreviewPicture { width, height, rgba }
}

/// Two pixels a character: the upper one its color, the lower one that behind it. What is transparent stays as it is.
fn blocks(picture: &PreviewPicture) -> String {
    let mut out = String::new();
    for y in (0..picture.height).step_by(2) {
        for x in 0..picture.width {
            let at = |y: u32| {
                let seen = picture.rgba.get((y * picture.width + x) as usize).filter(|_| y < picture.height);
                seen.filter(|p| p[3] >= 128)
            };
            let color = |layer: u8, p: &[u8; 4]| format!("\x1b[{layer};2;{};{};{}m", p[0], p[1], p[2]);
            out += &match (at(y), at(y + 1)) {
                (None, None) => " ".into(),
                (Some(p), None) => format!("{}\u{2580}\x1b[0m", color(38, p)),
                (None, Some(p)) => format!("{}\u{2584}\x1b[0m", color(38, p)),
                (Some(p), Some(q)) => format!("{}{}\u{2580}\x1b[0m", color(38, p), color(48, q)),
            };
        }
        out.truncate(out.trim_end_matches(' ').len());
        out.push('\n');
    }
    out
}

fn kitty(coded: &str) -> String {
    let mut out = String::new();
    let pieces = coded.len().div_ceil(PIECE);
    for (i, piece) in coded.as_bytes().chunks(PIECE).enumerate() {
        let head = if i == 0 { "a=T,f=100," } else { "" };
        let more = u8::from(i + 1 < pieces);
        let _ = write!(out, "\x1b_G{head}m={more};{}\x1b\\", String::from_utf8_lossy(piece));
    }
    out.push('\n');
    out
}

/// Six rows at a time, one color after the other; the colors are a cube.
fn sixel(picture: &PreviewPicture) -> String {
    let mut out = format!("\x1bPq\"1;1;{};{}", picture.width, picture.height);
    let percent = |v: u32| v * 100 / (STEPS - 1);
    for k in 0..STEPS.pow(3) {
        let (r, g, b) = (k / STEPS.pow(2), k / STEPS % STEPS, k % STEPS);
        let _ = write!(out, "#{k};2;{};{};{}", percent(r), percent(g), percent(b));
    }
    let index = |&[r, g, b, a]: &[u8; 4]| {
        let step = |v: u8| (u32::from(v) * (STEPS - 1) + 127) / 255;
        (a >= 128).then(|| (step(r) * STEPS + step(g)) * STEPS + step(b))
    };
    for band in picture.rgba.chunks(6 * picture.width as usize) {
        let colors: Vec<Option<u32>> = band.iter().map(index).collect();
        let mut used: Vec<u32> = colors.iter().flatten().copied().collect();
        used.sort_unstable();
        used.dedup();
        for color in used {
            let _ = write!(out, "#{color}");
            let bits = |x: usize| {
                let column = colors.iter().skip(x).step_by(picture.width as usize);
                column.enumerate().map(|(row, c)| u8::from(*c == Some(color)) << row).sum::<u8>()
            };
            let mut x = 0;
            while x < picture.width as usize {
                let own = bits(x);
                let run = (x..picture.width as usize).take_while(|&x| bits(x) == own).count();
                let _ = write!(out, "!{run}{}", char::from(63 + own));
                x += run;
            }
            out.push('$');
        }
        out.push('-');
    }
    out + "\x1b\\\n"
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_terminal_gets_what_it_says_it_can_show() {
        let of = |name: &'static str, value: &'static str| {
            protocol(|v| if v == name { value.to_string() } else { String::new() })
        };
        assert_eq!(of("TERM", "xterm-kitty"), Protocol::Kitty);
        assert_eq!(of("TERM_PROGRAM", "iTerm.app"), Protocol::Iterm);
        assert_eq!(of("TERM", "foot"), Protocol::Sixel);
        assert_eq!(of("TERM", "xterm-256color"), Protocol::Blocks);
    }

    #[test]
    fn two_pixels_share_a_character_and_nothing_stays_nothing() {
        let (red, blue, none) = ([255, 0, 0, 255], [0, 0, 255, 255], [0; 4]);
        let picture = PreviewPicture { width: 2, height: 3, rgba: vec![red, none, blue, none, none, blue] };
        let first = "\x1b[38;2;255;0;0m\x1b[48;2;0;0;255m\u{2580}\x1b[0m\n";
        assert_eq!(blocks(&picture), format!("{first} \x1b[38;2;0;0;255m\u{2580}\x1b[0m\n"));
        // halves: red and nothing above nothing and nothing is red of half the opacity
        let four = PreviewPicture { width: 2, height: 2, rgba: vec![red, red, none, none] };
        assert_eq!(smaller(&four, 1).rgba, [[255, 0, 0, 128]]);
    }

    #[test]
    fn a_sixel_has_a_bit_for_each_of_six_rows() {
        let (white, black) = ([255; 4], [0, 0, 0, 255]);
        // white above black, three times: white bits 0, 2 and 4, black 1, 3 and 5
        let picture = PreviewPicture { width: 1, height: 6, rgba: [white, black].repeat(3) };
        let text = sixel(&picture);
        let data = text.rsplit_once("#215;2;100;100;100").unwrap().1;
        let (white, black) = (char::from(63 + 0b010101), char::from(63 + 0b101010));
        assert_eq!(data, format!("#0!1{black}$#215!1{white}$-\x1b\\\n"));
    }
}
