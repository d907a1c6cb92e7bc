//! Tables of text as other programs export them: their encoding, what separates their columns, and
//! decimal commas.

/// Returns the text of a file: UTF-8 or UTF-16, with a byte order mark or without, else Latin-1.
/// Lines end as [`str::lines`] has it, those of old Macs, too.
pub(super) fn decoded(bytes: &[u8]) -> String {
    let text = match utf16(bytes) {
        Some((units, unit)) => from_utf16(units, unit),
        None => from_bytes(bytes.strip_prefix(b"\xEF\xBB\xBF").unwrap_or(bytes)),
    };
    if text.contains('\n') { text } else { text.replace('\r', "\n") }
}

/// Returns the bytes of UTF-16 without their mark, and how two of them make a unit; `None` for
/// other text.
pub(super) fn utf16(bytes: &[u8]) -> Option<(&[u8], fn([u8; 2]) -> u16)> {
    match bytes {
        [0xFF, 0xFE, rest @ ..] => Some((rest, u16::from_le_bytes)),
        [0xFE, 0xFF, rest @ ..] => Some((rest, u16::from_be_bytes)),
        // two letters of ASCII
        [1..=0x7F, 0, 1..=0x7F, 0, ..] => Some((bytes, u16::from_le_bytes)),
        [0, 1..=0x7F, 0, 1..=0x7F, ..] => Some((bytes, u16::from_be_bytes)),
        _ => None,
    }
}

fn from_utf16(bytes: &[u8], unit: fn([u8; 2]) -> u16) -> String {
    let units = bytes.chunks_exact(2).map(|pair| unit([pair[0], pair[1]]));
    char::decode_utf16(units).map(|c| c.unwrap_or(char::REPLACEMENT_CHARACTER)).collect()
}

fn from_bytes(bytes: &[u8]) -> String {
    let latin1 = || bytes.iter().map(|&b| char::from(b)).collect();
    std::str::from_utf8(bytes).map_or_else(|_| latin1(), str::to_owned)
}

/// Columns are looked up by name for every row.
const MAX_COLUMNS: usize = 256;

/// The heading of a table.
#[derive(Debug)]
pub(super) struct Heading {
    /// The names of the columns in small letters, without quotes and `#`.
    pub columns: Vec<String>,
    /// `;`, a tab, a comma, or a blank for any number of blanks.
    pub separator: char,
    /// How many lines come before the rows.
    lines: usize,
}

impl Heading {
    /// Returns the heading whose first columns are called so. Comments and Excel's `sep=` may come
    /// before it.
    pub fn find(text: &str, first: &[&str]) -> Option<Heading> {
        for (i, line) in text.lines().enumerate().filter(|(_, line)| !line.trim().is_empty()).take(16) {
            let separator = [';', '\t', ','].into_iter().find(|s| line.contains(*s)).unwrap_or(' ');
            let name = |field: String| field.trim_start_matches('#').trim().to_lowercase();
            let without_mark = line.trim_start().trim_start_matches('#');
            let columns: Vec<String> = fields(without_mark, separator).into_iter().map(name).collect();
            if (first.len()..MAX_COLUMNS).contains(&columns.len())
                && columns.iter().zip(first).all(|(a, b)| a == b)
            {
                return Some(Heading { columns, separator, lines: i + 1 });
            }
            let is_before = line.trim_start().starts_with('#') || line.to_lowercase().starts_with("sep=");
            if !is_before {
                return None;
            }
        }
        None
    }

    /// Returns the rows that are not blank, with the numbers of their lines, which begin at 1.
    pub fn rows<'t>(&self, text: &'t str) -> impl Iterator<Item = (usize, &'t str)> {
        let rows = text.lines().enumerate().skip(self.lines).map(|(i, line)| (i + 1, line));
        rows.filter(|(_, line)| !line.trim().is_empty())
    }

    /// Returns the values of a row, or why there are more of them than columns.
    pub fn values(&self, row: &str) -> Result<Vec<String>, String> {
        let mut values = fields(row, self.separator);
        let count = values.iter().rposition(|v| !v.is_empty()).map_or(0, |last| last + 1);
        values.truncate(count.max(self.columns.len()));
        if count <= self.columns.len() {
            return Ok(values);
        }
        let why = match self.separator {
            ',' => ": commas both between and inside numbers",
            ' ' => ": blanks both between and inside values",
            _ => "",
        };
        Err(format!("{count} values for {} columns{why}", self.columns.len()))
    }

    /// Returns the value of a column.
    pub fn value<'v>(&self, values: &'v [String], column: &str) -> Option<&'v str> {
        let place = self.columns.iter().position(|c| c == column)?;
        values.get(place).map(String::as_str)
    }
}

/// Returns the values of a line, without the quotes around those that hold separators; `""` inside
/// is a quote (RFC 4180).
fn fields(line: &str, separator: char) -> Vec<String> {
    let (mut all, mut quoted) = (vec![String::new()], false);
    let mut chars = line.chars().peekable();
    while let Some(c) = chars.next() {
        match c {
            '"' if !quoted || chars.next_if_eq(&'"').is_none() => quoted = !quoted,
            c if c == separator && !quoted => all.push(String::new()),
            c => all.last_mut().into_iter().for_each(|field| field.push(c)),
        }
    }
    let trimmed = all.iter().map(|field| field.trim().to_string());
    trimmed.filter(|field| separator != ' ' || !field.is_empty()).collect()
}

/// Returns a finite number, which may be written with a decimal comma.
pub(super) fn number(text: &str) -> Option<f64> {
    let is_decimal_comma = text.matches(',').count() == 1 && !text.contains('.');
    let value = if is_decimal_comma { text.replace(',', ".").parse() } else { text.parse::<f64>() };
    value.ok().filter(|v| v.is_finite())
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn quoted_fields_hold_commas_and_doubled_quotes() {
        assert_eq!(fields(r#""a ""b"", c.png",1,"", 2"#, ','), [r#"a "b", c.png"#, "1", "", "2"]);
        assert_eq!(fields("a.png  1,5\t2", ' '), ["a.png", "1,5\t2"]);
    }

    #[test]
    fn the_same_text_is_read_from_every_encoding() {
        let text = "#Größe;1\r\n";
        let units = || text.encode_utf16();
        let little: Vec<u8> = units().flat_map(u16::to_le_bytes).collect();
        let big: Vec<u8> = units().flat_map(u16::to_be_bytes).collect();
        let latin1: Vec<u8> = text.chars().map(|c| c as u8).collect();
        let marked = |mark: &[u8], rest: &[u8]| [mark, rest].concat();
        for bytes in [
            text.as_bytes().to_vec(),
            marked(b"\xEF\xBB\xBF", text.as_bytes()),
            marked(b"\xFF\xFE", &little),
            marked(b"\xFE\xFF", &big),
            little,
            big,
            latin1,
        ] {
            assert_eq!(decoded(&bytes), text, "{bytes:?}");
        }
        assert_eq!(decoded(b"a\rb"), "a\nb");
        assert_eq!((decoded(b""), decoded(b"\xFF\xFE\x61")), (String::new(), String::new()));
    }

    #[test]
    fn a_heading_is_found_whatever_separates_it_and_comes_before_it() {
        let found = |text: &str| Heading::find(text, &["name", "x"]).map(|h| (h.separator, h.lines));
        for (text, expected) in [
            ("#name,x,y\n", (',', 1)),
            ("Name;X;Y", (';', 1)),
            ("sep=;\n\n# cameras 3\n#name;x\n", (';', 4)),
            ("\"#name\"\t\"x\"", ('\t', 1)),
            ("# name   x  y", (' ', 1)),
        ] {
            assert_eq!(found(text), Some(expected), "{text:?}");
        }
        for text in ["", "#name", "a,b\n#name,x", "#label,x"] {
            assert_eq!(found(text), None, "{text:?}");
        }
    }

    #[test]
    fn numbers_have_a_point_or_one_comma() {
        assert_eq!(
            ["1.5", "1,5", "-0,5e-1", "7"].map(number),
            [Some(1.5), Some(1.5), Some(-0.05), Some(7.0)]
        );
        assert_eq!(["1.234,5", "1,2,3", "inf", "", "x"].map(number), [None; 5]);
    }
}
