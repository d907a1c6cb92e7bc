//! The house rules that can be read from the source: who may know whom, who opens files, who prints.

use std::fs;
use std::path::{Path, PathBuf};

/// Layers from the ground up; a module may know those below its own layer.
const LAYERS: &[(&str, &[&str])] = &[
    ("ground", &["error", "monitor", "geom", "image", "io", "config", "kernel"]),
    ("shared", &["capture", "field", "onnx", "run", "report"]),
    ("stages", &["mask", "tface", "iface", "mesh", "render", "ensemble", "metrics"]),
    ("pipeline", &["pipeline"]),
    ("cli", &["cli"]),
];

/// Modules of these layers may know each other; stages never.
const SOCIABLE: &[&str] = &["ground", "shared", "pipeline", "cli"];

struct Source {
    module: String,
    path: PathBuf,
    /// Lines of code with their numbers: no comments, nothing of the tests.
    lines: Vec<(usize, String)>,
}

fn layer(module: &str) -> Option<usize> {
    LAYERS.iter().position(|(_, modules)| modules.contains(&module))
}

fn sources() -> Vec<Source> {
    let src = Path::new(env!("CARGO_MANIFEST_DIR")).join("src");
    let mut files = Vec::new();
    collect(&src, &mut files);
    files.sort();
    files.iter().filter_map(|path| read(&src, path)).collect()
}

fn collect(folder: &Path, files: &mut Vec<PathBuf>) {
    for entry in fs::read_dir(folder).unwrap() {
        let path = entry.unwrap().path();
        if path.is_dir() {
            collect(&path, files);
        } else if path.extension().is_some_and(|e| e == "rs") {
            files.push(path);
        }
    }
}

fn read(src: &Path, path: &Path) -> Option<Source> {
    let below = path.strip_prefix(src).unwrap();
    let module = below.iter().next().unwrap().to_str().unwrap().trim_end_matches(".rs").to_string();
    let name = path.file_stem().unwrap().to_str().unwrap();
    // the crate's own two roots know everything; whole files of tests may too
    if module == "lib" || module == "main" || name == "tests" || name.ends_with("_tests") {
        return None;
    }
    let text = fs::read_to_string(path).unwrap();
    let lines = without_tests(&text)
        .into_iter()
        .filter(|(_, line)| !line.trim_start().starts_with("//"))
        .map(|(i, line)| (i + 1, line.split(" // ").next().unwrap_or_default().to_string()))
        .collect();
    Some(Source { module, path: below.to_path_buf(), lines })
}

/// The numbered lines of a formatted file without the items under `#[cfg(test)]`, wherever they stand.
fn without_tests(text: &str) -> Vec<(usize, &str)> {
    let indent = |line: &str| line.len() - line.trim_start().len();
    let mut lines = text.lines().enumerate();
    let mut kept = Vec::new();
    while let Some((i, line)) = lines.next() {
        if line.trim() != "#[cfg(test)]" {
            kept.push((i, line));
            continue;
        }
        // an item ends where a line as far in as its attribute ends it
        let ends = |l: &str| !l.is_empty() && indent(l) == indent(line) && l.ends_with([';', '}', ',']);
        lines.find(|(_, l)| ends(l));
    }
    kept
}

/// Modules of this crate named on a line: `crate::geom::Ray`, `use crate::{geom, image::Photo}`.
fn named(line: &str) -> Vec<String> {
    let word = |text: &str| -> String {
        text.trim_start().chars().take_while(|c| c.is_alphanumeric() || *c == '_').collect()
    };
    let mut found = Vec::new();
    for rest in line.split("crate::").skip(1) {
        match rest.strip_prefix('{') {
            None => found.push(word(rest)),
            Some(list) => {
                let mut depth = 0;
                let mut start = true;
                for (i, c) in list.char_indices() {
                    if start && !c.is_whitespace() {
                        found.push(word(&list[i..]));
                        start = false;
                    }
                    match c {
                        '{' => depth += 1,
                        '}' => depth -= 1,
                        ',' if depth == 0 => start = true,
                        _ => {}
                    }
                    if depth < 0 {
                        break;
                    }
                }
            }
        }
    }
    found.retain(|w| !w.is_empty());
    found
}

#[test]
fn arrows_point_down_only() {
    let mut wrong = Vec::new();
    for source in sources() {
        let Some(own) = layer(&source.module) else {
            wrong.push(format!("src/{}: the module `{}` has no layer", source.path.display(), source.module));
            continue;
        };
        for (number, line) in &source.lines {
            for other in named(line) {
                let Some(theirs) = layer(&other) else { continue }; // a macro or a type at the root
                let sociable = other == source.module || SOCIABLE.contains(&LAYERS[own].0);
                if theirs > own || (theirs == own && !sociable) {
                    let (a, b) = (LAYERS[own].0, LAYERS[theirs].0);
                    let at = source.path.display();
                    wrong.push(format!("src/{at}:{number}: `{}` ({a}) knows `{other}` ({b})", source.module));
                }
            }
        }
    }
    assert!(wrong.is_empty(), "\n{}", wrong.join("\n"));
}

fn nobody_else(module: &str, words: &[&str]) {
    let mut wrong = Vec::new();
    for source in sources().iter().filter(|s| s.module != module) {
        for (number, line) in &source.lines {
            for word in words.iter().filter(|w| stands_in(line, w)) {
                wrong.push(format!("src/{}:{number}: `{word}`", source.path.display()));
            }
        }
    }
    assert!(wrong.is_empty(), "only `{module}` does this:\n{}", wrong.join("\n"));
}

/// Does a word stand in a line, not as the end of a longer one (`NetworkFile::` is not `File::`)?
fn stands_in(line: &str, word: &str) -> bool {
    let part = |c: char| c.is_alphanumeric() || c == '_';
    line.match_indices(word).any(|(at, _)| !line[..at].ends_with(part))
}

#[test]
fn only_io_opens_files() {
    nobody_else("io", &["std::fs", "fs::", "File::", "OpenOptions"]);
}

#[test]
fn only_cli_prints_and_exits() {
    nobody_else("cli", &["println!", "eprintln!", "print!(", "eprint!(", "dbg!", "process::exit"]);
}

#[test]
fn no_module_is_called_by_an_empty_word() {
    for source in sources() {
        for part in source.path.iter().filter_map(|p| p.to_str()) {
            let name = part.trim_end_matches(".rs");
            assert!(!["utils", "util", "common", "manager", "helper", "helpers"].contains(&name), "{part}");
        }
    }
}

#[test]
fn names_are_found_in_every_way_to_write_them() {
    assert_eq!(named("use crate::geom::{Aabb, Ray};"), ["geom"]);
    assert_eq!(named("use crate::{geom::{Aabb, Ray}, image::Photo, run};"), ["geom", "image", "run"]);
    assert_eq!(named("    let x = crate::io::read(crate::run::Quiet);"), ["io", "run"]);
    assert!(named("use super::geom;").is_empty());
}

#[test]
fn only_the_items_under_the_attribute_are_tests() {
    let text = "use a;\n#[cfg(test)]\nmod tests;\nuse b;\n#[cfg(test)]\n#[path = \"c\"]\nmod c {\n    use d;\n}\nuse e;\n\
                impl F {\n    #[cfg(test)]\n    fn g(\n        h: I,\n    ) -> J {\n        k;\n    }\n\n    fn l() {}\n}";
    let kept: Vec<&str> = without_tests(text).into_iter().map(|(_, line)| line.trim()).collect();
    assert_eq!(kept, ["use a;", "use b;", "use e;", "impl F {", "", "fn l() {}", "}"]);
}
