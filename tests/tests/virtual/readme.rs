//! What the README and the manual show is what runs: their programs are compared with the files
//! from which they come.

use std::fs;
use std::path::Path;

fn file(path: &str) -> String {
    let root = Path::new(env!("CARGO_MANIFEST_DIR")).parent().expect("the folder of the workspace");
    fs::read_to_string(root.join(path)).unwrap_or_else(|error| panic!("{path}: {error}"))
}

/// The first block that opens so below a heading of a page.
fn shown(path: &str, heading: &str, opening: &str) -> String {
    let page = file(path);
    let below = page.split_once(heading).unwrap_or_else(|| panic!("no {heading:?} in {path}")).1;
    let block = below.split_once(opening).expect("a block below the heading").1;
    block.split_once("\n```").expect("the end of the block").0.to_owned()
}

/// A file from its first line of code on: without the lines about the file itself.
fn code_of(path: &str) -> String {
    let text = file(path);
    let about = |line: &&str| line.starts_with("//!") || line.starts_with("#!") || line.is_empty();
    let lines: Vec<&str> = text.lines().skip_while(about).collect();
    lines.join("\n")
}

#[test]
fn each_program_that_a_page_shows_is_the_code_of_a_file() {
    let facade = file("actors/src/lib.rs");
    let docs = facade.lines().filter_map(|line| line.strip_prefix("//!"));
    let docs: Vec<&str> = docs.map(|line| line.strip_prefix(' ').unwrap_or(line)).collect();
    let docs = docs.join("\n");
    let facade = docs.split("\n```\n").nth(1).expect("a program").to_owned();
    let readme = shown("README.md", "## A program", "```rust\n");
    let testing = "actors/src/manual/testing.md";
    for (page, program, source) in [
        ("README.md", readme, "examples/examples/hello.rs"),
        ("actors/src/lib.rs", facade, "examples/examples/hello.rs"),
        (
            testing,
            shown(testing, "## One component", "```text\n"),
            "actors/testkit/tests/virtual/component.rs",
        ),
        (
            testing,
            shown(testing, "# Testing", "```text\n"),
            "actors/testkit/tests/virtual/manual.rs",
        ),
    ] {
        let code = code_of(source);
        let differs = program.lines().zip(code.lines()).find(|(left, right)| left != right);
        assert!(
            program == code,
            "they differ, first at {differs:?}\nWhat to do: copy the code of {source}, from its \
             first `use` on, into {page}"
        );
    }
}

#[test]
fn every_example_is_in_the_table_of_the_readme_and_run_by_a_test() {
    let (readme, runs) = (file("README.md"), file("examples/tests/real/examples.rs"));
    let root = Path::new(env!("CARGO_MANIFEST_DIR")).parent().expect("the folder of the workspace");
    for entry in fs::read_dir(root.join("examples/examples")).expect("the folder of examples") {
        let path = entry.expect("an entry of that folder").path();
        let name = path.file_stem().and_then(|name| name.to_str()).expect("a name in UTF-8");
        let row = format!("| [`{name}`](examples/examples/{name}.rs) |");
        assert!(readme.contains(&row), "README.md has no row {row}: add it, with the lesson");
        let run = format!("fn {name}_");
        assert!(
            runs.contains(&run),
            "examples/tests/real/examples.rs has no test {run}..: add one"
        );
    }
}
