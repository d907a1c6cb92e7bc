"""Wraps the comments of Rust files at 100 columns.

    python tools/reference/wrap_comments.py            wraps in place
    python tools/reference/wrap_comments.py --check    lists what is too long, and exits with 1 if anything is

A paragraph of `//`, `///` or `//!` is filled again if one of its lines is longer than 100 columns; all others stay as they
are, so a second run changes nothing. Blocks of code, tables, headings, definitions of links, drawings (lines with two spaces
or more inside) and comments behind code are never touched, and are listed if they are longer; spans of code and links are
not broken. Nothing but the places of line breaks changes, which is checked before a file is written.
"""

import re
import sys
from pathlib import Path

ROOT = Path(__file__).resolve().parents[2]
FOLDERS = ("src", "tests", "benches", "examples", "crates")
WIDTH = 100

COMMENT = re.compile(r"^( *)(///|//!|//)(?!/)( ?)(.*)$")
ITEM = re.compile(r"^( *)([-*+]|\d+[.)]) +(?=\S)")
KEPT = re.compile(r"^(#{1,6} |#!?\[|\||>|<|={3,}|-{3,}|\[[^\]]*\]:( |$))")
# a line that began with one of these would be another block of Markdown
GLUED = re.compile(r"^([-*+>|=]+|#+|\d+[.)]|\[[^\]]*\]:.*)$")
DRAWING = re.compile(r"\S {2,}\S")
BEGIN = re.compile(r"""//|/\*|["']|(?<!\w)(?:br|cr|r)(#*)\"""")
STRING = re.compile(r'"(?:\\.|[^"\\])*"?', re.DOTALL)
CHARACTER = re.compile(r"'(?:\\(?:u\{[0-9a-fA-F_]+\}|x[0-9a-fA-F]{2}|.)|[^\\'\n])'")


def sources():
    for folder in FOLDERS:
        yield from sorted(path for path in (ROOT / folder).rglob("*.rs") if "target" not in path.parts)


def comments(text):
    """The ranges of the line comments of a source, with strings, characters and block comments passed over."""
    found, i = [], 0
    while begin := BEGIN.search(text, i):
        i = begin.start()
        if begin[0] == "//":
            end = text.find("\n", i)
            end = len(text) if end < 0 else end
            found.append((i, end))
            i = end
        elif begin[0] == "/*":
            depth, i = 1, i + 2
            while depth and i < len(text):
                step = {"/*": 1, "*/": -1}.get(text[i : i + 2], 0)
                depth += step
                i += 2 if step else 1
        elif begin[0] == '"':
            i = STRING.match(text, i).end()
        elif begin[0] == "'":
            character = CHARACTER.match(text, i)
            i = character.end() if character else i + 1
        else:  # a raw string
            end = text.find('"' + begin[1], begin.end())
            i = len(text) if end < 0 else end + 1 + len(begin[1])
    return found


def words(paragraph):
    """The words of a paragraph: spans of code and links count as one, and no word begins another block."""
    text = " ".join(paragraph)
    found = []
    for piece in re.findall(r"(?:`+[^`]*`+|\[[^\]]*\]\([^)\s]*\)|\S)+", text):
        if found and GLUED.match(piece):
            found[-1] += " " + piece
        else:
            found.append(piece)
    return found


def filled(prefix, hang, paragraph):
    """The paragraph in lines of at most 100 columns; the first behind `prefix`, the others behind `hang`."""
    lines, line = [], ""
    for word in words(paragraph):
        lead = hang if lines else prefix
        if line and len(lead) + len(line) + 1 + len(word) > WIDTH:
            lines.append(lead + line)
            line = word
        else:
            line = f"{line} {word}" if line else word
    return [*lines, (hang if lines else prefix) + line]


def wrapped(lines):
    """A block of comment lines of one marker and one indent, wrapped."""
    out, paragraph = [], []  # the paragraph: lines as they are, with their text

    def close():
        nonlocal paragraph
        if any(len(line) > WIDTH for line, _ in paragraph):
            first = COMMENT.match(paragraph[0][0])
            lead = first.group(1) + first.group(2) + " "
            item = ITEM.match(first.group(4))
            text = first.group(4)
            depth = item.end() if item else len(text) - len(text.lstrip())
            begin = text[:depth]
            texts = [text[depth:], *(t.strip() for _, t in paragraph[1:])]
            out.extend(filled(lead + begin, lead + " " * depth, texts))
        else:
            out.extend(line for line, _ in paragraph)
        paragraph = []

    fenced, depth = False, 0
    for line in lines:
        text = COMMENT.match(line).group(4)
        bare = text.strip()
        indent = len(text) - len(text.lstrip())
        item = ITEM.match(text)
        if bare.startswith(("```", "~~~")):
            close()
            fenced = not fenced
            out.append(line)
        elif fenced or not bare or KEPT.match(bare) or DRAWING.search(ITEM.sub("", text).strip()):
            close()
            out.append(line)
            depth = 0 if not bare else depth
        elif item:
            close()
            depth = item.end()
            paragraph = [(line, text)]
        elif indent >= depth + 4:  # a block of code
            close()
            out.append(line)
        else:
            if not paragraph or indent != depth or bare.startswith("SAFETY:"):
                close()
                depth = indent
            paragraph.append((line, text))
    close()
    return out


def blocks(text):
    """The ranges of lines: blocks of comments of one marker and one indent."""
    lines = text.split("\n")
    starts, at = {}, 0
    for number, line in enumerate(lines):
        starts[at + len(line) - len(line.lstrip(" "))] = number
        at += len(line) + 1
    whole = {starts[begin] for begin, _ in comments(text) if begin in starts}
    kinds = {number: COMMENT.match(lines[number]) for number in whole}
    begin = 0
    while begin < len(lines):
        end, kind = begin + 1, kinds.get(begin)
        while kind and kinds.get(end) and kinds[end].group(1, 2) == kind.group(1, 2):
            end += 1
        yield begin, end, bool(kind)
        begin = end


def rewrap(text):
    """A source with its comments wrapped."""
    lines, out = text.split("\n"), []
    for begin, end, is_comment in blocks(text):
        out.extend(wrapped(lines[begin:end]) if is_comment else lines[begin:end])
    return "\n".join(out)


def code(text):
    """A source without its line comments, and without the space around them."""
    out, at = [], 0
    for begin, end in comments(text):
        out.append(text[at:begin])
        at = end
    return "".join("".join([*out, text[at:]]).split())


def prose(text):
    """The words of all line comments of a source."""
    return [word for begin, end in comments(text) for word in text[begin:end].lstrip("/!").split()]


def too_long(text):
    """The lines with a comment that are too long, by number."""
    lines = text.split("\n")
    commented = {text.count("\n", 0, begin) for begin, _ in comments(text)}
    return sorted(number + 1 for number in commented if len(lines[number]) > WIDTH)


def main():
    check = sys.argv[1:] == ["--check"]
    if sys.argv[1:] and not check:
        sys.exit(__doc__)
    wrong = 0
    for path in sources():
        text = path.read_text()
        new = rewrap(text)
        if code(new) != code(text) or prose(new) != prose(text) or rewrap(new) != new:
            sys.exit(f"{path.relative_to(ROOT)}: wrapping would change more than line breaks")
        if not check and new != text:
            path.write_text(new)
        shown = text if check else new
        for number in too_long(shown):
            wrong += 1
            print(f"{path.relative_to(ROOT)}:{number}: {len(shown.split(chr(10))[number - 1])} columns")
    if wrong:
        print(f"{wrong} lines with comments are longer than {WIDTH} columns")
    sys.exit(1 if wrong else 0)


if __name__ == "__main__":
    main()
