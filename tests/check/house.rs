//! The house rules that the compiler does not see: who may know whom within the package `tiface`;
//! no cycle of files within any package; who opens files, who prints; no empty names; keys that
//! messages name exist, and code names keys by the macro.

use std::collections::{BTreeMap, BTreeSet};
use std::fs;
use std::path::{Path, PathBuf};

/// Layers of the package `tiface`, from the ground up; a module may know those below its own layer.
const LAYERS: &[(&str, &[&str])] = &[
    ("settings", &["config"]),
    ("shared", &["field", "onnx", "run", "report"]),
    ("stages", &["mask", "tface", "iface", "ensemble", "metrics"]),
    ("pipeline", &["pipeline"]),
    ("cli", &["cli"]),
];

/// Modules of these layers may know each other; stages never.
const SOCIABLE: &[&str] = &["settings", "shared", "pipeline", "cli"];

/// The package of the pipeline and of the program, at the root of the workspace.
const ROOT: &str = "tiface";

struct Source {
    package: String,
    module: String,
    /// Path from the package's `src`.
    path: PathBuf,
    /// Path from the root of the workspace.
    place: String,
    /// Lines of code with their numbers: no comments, nothing of the tests.
    lines: Vec<(usize, String)>,
}

fn layer(module: &str) -> Option<usize> {
    LAYERS.iter().position(|(_, modules)| modules.contains(&module))
}

fn sources() -> Vec<Source> {
    let root = Path::new(env!("CARGO_MANIFEST_DIR"));
    let mut packages = vec![(ROOT.to_string(), root.join("src"))];
    for entry in fs::read_dir(root.join("crates")).unwrap() {
        let entry = entry.unwrap();
        packages.push((entry.file_name().to_str().unwrap().into(), entry.path().join("src")));
    }
    let mut all = Vec::new();
    for (package, src) in packages {
        let mut files = Vec::new();
        collect(&src, &mut files);
        files.sort();
        let place = |path: &Path| path.strip_prefix(root).unwrap().display().to_string();
        all.extend(files.iter().filter_map(|path| read(&package, &src, path, place(path))));
    }
    all
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

fn read(package: &str, src: &Path, path: &Path, place: String) -> Option<Source> {
    let below = path.strip_prefix(src).unwrap();
    let module = below.iter().next().unwrap().to_str().unwrap().trim_end_matches(".rs").to_string();
    let name = path.file_stem().unwrap().to_str().unwrap();
    // the two roots of the program know everything; whole files of and for tests may too
    if (package == ROOT && ["lib", "main"].contains(&module.as_str()))
        || ["tests", "testing"].contains(&name)
        || name.ends_with("_tests")
    {
        return None;
    }
    let text = fs::read_to_string(path).unwrap();
    let lines = without_tests(&text)
        .into_iter()
        .filter(|(_, line)| !line.trim_start().starts_with("//"))
        .map(|(i, line)| (i + 1, line.split(" // ").next().unwrap_or_default().to_string()))
        .collect();
    Some(Source { package: package.into(), module, path: below.to_path_buf(), place, lines })
}

/// The numbered lines of a formatted file without the items under `#[cfg(test)]`, wherever they
/// stand.
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

/// Paths that begin with one of `roots` in a piece of code: `crate::geom::Ray`,
/// `use super::{tile::Tile, Bins}`.
fn paths(code: &str, roots: &[&str]) -> Vec<Vec<String>> {
    let mut found = Vec::new();
    for root in roots {
        let start = format!("{root}::");
        for (at, _) in code.match_indices(&start).filter(|(at, _)| stands_at(code, *at)) {
            branches(&code[at + start.len()..], &[root.to_string()], &mut found);
        }
    }
    found
}

/// The paths of a tree behind `stem::`, and what is left behind it.
fn branches<'c>(code: &'c str, stem: &[String], found: &mut Vec<Vec<String>>) -> &'c str {
    let code = code.trim_start();
    if let Some(mut rest) = code.strip_prefix('{') {
        loop {
            rest = rest.trim_start().trim_start_matches(',').trim_start();
            match rest.strip_prefix('}') {
                Some(behind) => return behind,
                None if rest.is_empty() => return rest,
                None => {}
            }
            let behind = branches(rest, stem, found);
            // `as name`, or no tree of paths at all
            rest = behind.trim_start_matches(|c: char| c != ',' && c != '}');
        }
    }
    let end = code.find(|c: char| !(c.is_alphanumeric() || c == '_')).unwrap_or(code.len());
    let path = [stem, &[code[..end].to_string()]].concat();
    match code[end..].strip_prefix("::") {
        Some(rest) if end > 0 => branches(rest, &path, found),
        _ => {
            found.push(path);
            &code[end..]
        }
    }
}

/// Modules of this crate that a line names.
fn named(line: &str) -> Vec<String> {
    let mut found: Vec<String> = paths(line, &["crate"]).into_iter().map(|path| path[1].clone()).collect();
    found.dedup();
    found
}

#[test]
fn arrows_point_down_only() {
    let mut wrong = Vec::new();
    for source in sources().into_iter().filter(|source| source.package == ROOT) {
        let Some(own) = layer(&source.module) else {
            wrong.push(format!("{}: the module `{}` has no layer", source.place, source.module));
            continue;
        };
        for (number, line) in &source.lines {
            for other in named(line) {
                let Some(theirs) = layer(&other) else { continue }; // a macro or a type at the root
                let sociable = other == source.module || SOCIABLE.contains(&LAYERS[own].0);
                if theirs > own || (theirs == own && !sociable) {
                    let (a, b) = (LAYERS[own].0, LAYERS[theirs].0);
                    let at = &source.place;
                    wrong.push(format!("{at}:{number}: `{}` ({a}) knows `{other}` ({b})", source.module));
                }
            }
        }
    }
    assert!(wrong.is_empty(), "\n{}", wrong.join("\n"));
}

/// Opening a capture needs no poses measured, no exposures.
#[test]
fn captures_know_no_rigs() {
    let mut wrong = Vec::new();
    for source in sources().iter().filter(|s| s.package == "tiface-capture" && s.module != "rig") {
        let knows = |line: &str| named(line).iter().any(|module| module == "rig");
        let lines = source.lines.iter().filter(|(_, line)| knows(line));
        wrong.extend(lines.map(|(number, _)| format!("{}:{number}", source.place)));
    }
    assert!(wrong.is_empty(), "`rig` knows captures, not the other way round:\n{}", wrong.join("\n"));
}

/// A module of a package: what it names of others there, and what it hands on (`pub use`), as paths
/// that begin with the package.
struct Module {
    names: Vec<Vec<String>>,
    hands_on: Vec<Vec<String>>,
}

fn modules() -> BTreeMap<Vec<String>, Module> {
    let place = |source: &Source| -> Vec<String> {
        let parts = source.path.with_extension("");
        let parts = parts.iter().map(|p| p.to_str().unwrap().to_string());
        // the root of a package has its name alone
        let parts = parts.filter(|part| part != "mod" && part != "lib");
        [source.package.clone()].into_iter().chain(parts).collect()
    };
    let sources = sources();
    let all: Vec<Vec<String>> = sources.iter().map(place).collect();
    let of = |source: &Source| {
        let module = place(source);
        let children = all.iter().filter(|m| m[..m.len() - 1] == module).map(|m| m[m.len() - 1].as_str());
        let roots: Vec<&str> = ["crate", "super", "self"].into_iter().chain(children).collect();
        let absolute = |path: Vec<String>| -> Option<Vec<String>> {
            let ups = path.iter().take_while(|part| *part == "super").count();
            let from = if ["crate", "self"].contains(&path[0].as_str()) { 1 } else { ups };
            let up = if path[0] == "crate" { module.len() - 1 } else { ups };
            Some([&module[..module.len().checked_sub(up)?], &path[from..]].concat())
        };
        let [mut names, mut hands_on] = [String::new(), String::new()];
        let mut is_handed_on = false;
        for (_, line) in &source.lines {
            is_handed_on |= line.trim_start().starts_with("pub") && line.contains(" use ");
            *(if is_handed_on { &mut hands_on } else { &mut names }) += &format!("{line}\n");
            is_handed_on &= !line.contains(';');
        }
        let [names, hands_on] =
            [names, hands_on].map(|code| paths(&code, &roots).into_iter().filter_map(absolute).collect());
        (module, Module { names, hands_on })
    };
    sources.iter().map(of).collect()
}

/// The module that defines what a path names.
fn definer(path: &[String], modules: &BTreeMap<Vec<String>, Module>) -> Option<Vec<String>> {
    let place = (1..=path.len()).rev().map(|n| &path[..n]).find(|m| modules.contains_key(*m))?;
    let name = path.get(place.len());
    let handed = modules[place].hands_on.iter().find(|p| p.last() == name && p.len() > 1);
    handed.and_then(|p| definer(p, modules)).or_else(|| Some(place.to_vec()))
}

#[test]
fn no_files_know_each_other_in_a_circle() {
    let modules = modules();
    let knows = |module: &Vec<String>| -> BTreeSet<Vec<String>> {
        let others = modules[module].names.iter().filter_map(|path| definer(path, &modules));
        // a part of a file may know the whole
        others.filter(|other| !module.starts_with(other)).collect()
    };
    let knows: BTreeMap<_, _> = modules.keys().map(|module| (module.clone(), knows(module))).collect();
    let reached = |(from, _)| -> (&Vec<String>, BTreeSet<&Vec<String>>) {
        let (mut reached, mut next) = (BTreeSet::new(), vec![from]);
        while let Some(module) = next.pop() {
            next.extend(knows[module].iter().filter(|other| reached.insert(*other)));
        }
        (from, reached)
    };
    let reached: BTreeMap<_, _> = knows.iter().map(reached).collect();
    let circle = |m: &Vec<String>| -> BTreeSet<String> {
        reached[m].iter().filter(|other| reached[*other].contains(m)).map(|m| m.join("::")).collect()
    };
    let circles: BTreeSet<_> = modules.keys().map(circle).filter(|c| !c.is_empty()).collect();
    let rows: Vec<String> = circles.iter().map(|c| Vec::from_iter(c.clone()).join(", ")).collect();
    assert!(rows.is_empty(), "\n{}", rows.join("\n"));
}

fn nobody_else(package: &str, module: &str, words: &[&str]) {
    let mut wrong = Vec::new();
    for source in sources().iter().filter(|s| s.package != package || s.module != module) {
        for (number, line) in &source.lines {
            for word in words.iter().filter(|w| stands_in(line, w)) {
                wrong.push(format!("{}:{number}: `{word}`", source.place));
            }
        }
    }
    assert!(wrong.is_empty(), "only `{module}` of {package} does this:\n{}", wrong.join("\n"));
}

/// Does a word stand in a line, not as the end of a longer one (`NetworkFile::` is not `File::`)?
fn stands_in(line: &str, word: &str) -> bool {
    line.match_indices(word).any(|(at, _)| stands_at(line, at))
}

/// Does a word or a path begin here?
fn stands_at(line: &str, at: usize) -> bool {
    !line[..at].ends_with(|c: char| c.is_alphanumeric() || c == '_' || c == ':')
}

#[test]
fn only_io_opens_files() {
    nobody_else("tiface-base", "io", &["std::fs", "fs::", "File::", "OpenOptions"]);
}

#[test]
fn only_cli_prints_and_exits() {
    nobody_else(ROOT, "cli", &["println!", "eprintln!", "print!(", "eprint!(", "dbg!", "process::exit"]);
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
    let found = |code: &str| paths(code, &["super", "tile"]).iter().map(|p| p.join("::")).collect::<Vec<_>>();
    let tree = found("use super::{\n    Bins, paint::{self, Sheet as S},\n};");
    assert_eq!(tree, ["super::Bins", "super::paint::self", "super::paint::Sheet"]);
    let inline = found("use super::super::a; tile::put(my_tile::x, super::b!(1))");
    assert_eq!(inline, ["super::super::a", "super::b", "tile::put"]);
}

#[test]
fn only_the_items_under_the_attribute_are_tests() {
    let text = "use a;\n#[cfg(test)]\nmod tests;\nuse b;\n#[cfg(test)]\n#[path = \"c\"]\nmod c {\n    use d;\n}\nuse e;\n\
                impl F {\n    #[cfg(test)]\n    fn g(\n        h: I,\n    ) -> J {\n        k;\n    }\n\n    fn l() {}\n}";
    let kept: Vec<&str> = without_tests(text).into_iter().map(|(_, line)| line.trim()).collect();
    assert_eq!(kept, ["use a;", "use b;", "use e;", "impl F {", "", "fn l() {}", "}"]);
}

/// The texts between quotes of consecutive lines; one that a backslash continues stands in several
/// pieces.
fn texts(lines: &[(usize, String)]) -> Vec<(usize, String)> {
    let (mut found, mut is_open) = (Vec::new(), false);
    for (number, line) in lines {
        let line = line.replace("'\"'", "' '");
        let mut text = String::new();
        let mut chars = line.chars();
        while let Some(c) = chars.next() {
            match c {
                '\\' => drop(chars.next()),
                '"' => {
                    found.extend(is_open.then(|| (*number, std::mem::take(&mut text))));
                    is_open = !is_open;
                }
                c if is_open => text.push(c),
                _ => {}
            }
        }
        found.extend(is_open.then_some((*number, text)));
        is_open &= line.ends_with('\\');
    }
    found
}

/// What looks like a key and is none: a file, and tensors of a checkpoint.
const NO_KEYS: [&str; 4] = ["metrics.json", "mask.bounds", "mask.size", "mask.bits"];

#[test]
fn every_key_in_a_message_exists_and_code_names_keys_by_the_macro() {
    let known: BTreeSet<String> = tiface::config::keys().map(|(name, _)| name).collect();
    let tables: BTreeSet<&str> = known.iter().filter_map(|key| Some(key.split_once('.')?.0)).collect();
    let is_word = |c: char| c.is_ascii_alphanumeric() || c == '_';
    let mut wrong = Vec::new();
    for source in sources() {
        let at = &source.place;
        for (number, text) in texts(&source.lines) {
            // other packages know no configuration
            if known.contains(&text) && text.contains('.') && source.package == ROOT {
                wrong.push(format!("{at}:{number}: write key!({text})"));
            }
            for word in text.split(|c: char| !(is_word(c) || c == '.' || c == '/')) {
                let word = word.trim_end_matches('.');
                let is_key = word.split_once('.').is_some_and(|(table, _)| tables.contains(table));
                if is_key && !known.contains(word) && !NO_KEYS.contains(&word) {
                    wrong.push(format!("{at}:{number}: there is no key `{word}`"));
                }
            }
        }
    }
    assert!(wrong.is_empty(), "\n{}", wrong.join("\n"));
}

#[test]
fn texts_are_what_stands_between_quotes() {
    let lines = ["f(\"a \\\" b\", '\"', \"c\");", "g(\"d \\", "   e\");", "h(\"i"];
    let lines: Vec<(usize, String)> = lines.iter().map(|l| l.to_string()).enumerate().collect();
    let found: Vec<String> = texts(&lines).into_iter().map(|(_, text)| text.trim().into()).collect();
    assert_eq!(found, ["a  b", "c", "d", "e", "i"]);
}
