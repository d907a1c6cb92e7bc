//! What the program is made of: every crate from crates.io, under a license that `deny.toml`
//! allows, none that speaks to a network, and a note on each that the program names itself.

use std::path::Path;
use std::process::Command;

fn read(name: &str) -> String {
    std::fs::read_to_string(Path::new(env!("CARGO_MANIFEST_DIR")).join(name)).unwrap()
}

/// Returns the folders of the workspace's packages.
fn packages() -> Vec<String> {
    let folder = Path::new(env!("CARGO_MANIFEST_DIR")).join("crates");
    let below = std::fs::read_dir(folder).unwrap().map(|entry| entry.unwrap().file_name());
    let below = below.map(|name| format!("crates/{}", name.to_str().unwrap()));
    std::iter::once(".".to_string()).chain(below).collect()
}

/// Name, what stands behind the version, and license of every crate that a package is built from.
fn crates(options: &[&str]) -> Vec<(String, String, String)> {
    let output = Command::new(env!("CARGO"))
        .args(["tree", "--locked", "--edges", "normal,build", "--prefix", "none"])
        .args(["--format", "{p}|{l}"])
        .args(options)
        .current_dir(env!("CARGO_MANIFEST_DIR"))
        .output()
        .unwrap();
    assert!(output.status.success(), "{}", String::from_utf8_lossy(&output.stderr));
    let text = String::from_utf8(output.stdout).unwrap();
    let line = |line: &str| {
        let (package, license) = line.trim_end_matches(" (*)").split_once('|')?;
        let (name, rest) = package.split_once(' ')?;
        let source =
            rest.split_once(' ').map_or("", |(_, source)| source.trim_start_matches("(proc-macro)").trim());
        Some((name.to_string(), source.to_string(), license.to_string()))
    };
    let mut crates: Vec<_> = text.lines().filter_map(line).collect();
    crates.sort();
    crates.dedup();
    crates
}

/// Is one of the alternatives of an SPDX expression, and in it every part, allowed? Parentheses
/// stand around alternatives only: `(A OR B) AND C`.
fn allowed(expression: &str, list: &[&str]) -> bool {
    let all = |part: &str| {
        let any = part.trim().trim_matches(['(', ')']);
        any.replace('/', " OR ").split(" OR ").any(|license| list.contains(&license.trim()))
    };
    if expression.contains('(') || !expression.contains(" OR ") {
        return expression.split(" AND ").all(all);
    }
    expression.split(" OR ").any(|alternative| alternative.split(" AND ").all(all))
}

#[test]
fn every_crate_is_from_the_registry_under_an_allowed_license_and_without_a_network() {
    let deny: toml::Table = read("deny.toml").parse().unwrap();
    let list = |table: &str, key: &str| -> Vec<String> {
        let values = deny[table][key].as_array().unwrap();
        values.iter().map(|v| v.as_str().unwrap().to_string()).collect()
    };
    let (licenses, banned) = (list("licenses", "allow"), list("bans", "deny"));
    let licenses: Vec<&str> = licenses.iter().map(String::as_str).collect();
    let crates = crates(&["--features", "matting,wgpu"]);
    assert!(crates.len() > 300, "{}", crates.len());
    for (name, source, license) in &crates {
        let is_ours = source.starts_with(concat!("(", env!("CARGO_MANIFEST_DIR")));
        assert!(source.is_empty() || is_ours, "`{name}` comes from {source}");
        assert!(allowed(license, &licenses), "`{name}` is under `{license}`");
        assert!(!banned.contains(name), "`{name}` speaks to a network");
    }
}

#[test]
fn expressions_of_licenses_are_read() {
    let mine = ["MIT", "ISC"];
    for yes in ["MIT", "GPL-3.0 OR MIT", "MIT/GPL-3.0", "(GPL-3.0 OR MIT) AND ISC", "GPL-3.0 OR MIT AND ISC"]
    {
        assert!(allowed(yes, &mine), "{yes}");
    }
    for no in ["GPL-3.0", "MIT AND GPL-3.0", "(GPL-3.0 OR MIT) AND NCSA", "", "GPL-3.0 OR MIT AND NCSA"] {
        assert!(!allowed(no, &mine), "{no}");
    }
}

#[test]
fn every_crate_the_program_names_has_a_note_on_its_unsafe_code() {
    let mut named = Vec::new();
    for folder in packages() {
        let manifest: toml::Table = read(&format!("{folder}/Cargo.toml")).parse().unwrap();
        let unix = manifest.get("target").and_then(|target| target["cfg(unix)"].get("dependencies"));
        let tables = [Some(&manifest["dependencies"]), unix];
        named.extend(tables.into_iter().flatten().flat_map(|t| t.as_table().unwrap().keys().cloned()));
    }
    let notes = read("docs/dependencies.md");
    for name in named.into_iter().filter(|name| !name.starts_with("tiface-")) {
        assert!(notes.contains(&format!("`{name}`")), "docs/dependencies.md says nothing of `{name}`");
    }
}

#[test]
fn meshing_captures_and_kernels_know_the_base_alone_and_need_neither_tensors_nor_networks() {
    for package in ["tiface-capture", "tiface-kernels", "tiface-surface"] {
        let crates = crates(&["--package", package]);
        let ours = crates.iter().map(|(name, ..)| name.as_str()).filter(|name| name.starts_with("tiface"));
        assert_eq!(Vec::from_iter(ours), ["tiface-base", package]);
        for (name, ..) in &crates {
            let heavy = ["burn", "cubecl", "wgpu", "tract", "clap", "toml"];
            let is_heavy = heavy.iter().any(|word| name.starts_with(word));
            assert!(!is_heavy, "{package} needs `{name}`");
        }
    }
}
