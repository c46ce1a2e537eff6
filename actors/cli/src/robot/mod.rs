//! Robot files: their programs are started, the schema is printed, and a first robot is written.

use crate::args::{NewOptions, RobotOptions};
use crate::print;
use blastema_robot::program_of;
use std::ffi::OsString;
use std::io::{self, Write};
use std::os::unix::fs::MetadataExt;
use std::os::unix::process::CommandExt;
use std::path::{Path, PathBuf};
use std::process::Command;
use std::{env, fs};

/// The files of a new robot, and their texts. `{{name}}` stands for its name.
const FILES: [(&str, &str); 5] = [
    ("Cargo.toml", include_str!("../../template/Cargo.toml.in")),
    ("{{name}}.robot.xml", include_str!("../../template/robot.xml.in")),
    ("src/lib.rs", include_str!("../../template/lib.rs.in")),
    ("src/main.rs", include_str!("../../template/main.rs.in")),
    ("tests/robot.rs", include_str!("../../template/test.rs.in")),
];

/// The sources that this program was built from.
const SOURCES: &str = concat!(env!("CARGO_MANIFEST_DIR"), "/../..");

/// Names that no package of a robot can have: what Rust reserves or calls its own crates, what
/// Cargo calls its folders, and what the package depends on.
const TAKEN: &str = "abstract alloc as async await become blastema blastema_robot blastema_testkit box break \
    build const continue core crate deps do dyn else enum examples extern false final fn for gen \
    if impl in incremental let loop macro match mod move mut override priv proc_macro pub ref \
    return self static std struct super test trait true try type typeof unsafe unsized use \
    virtual where while";

/// Becomes the program of a robot file. False: the file has mistakes.
pub(crate) fn run(command: &str, options: &RobotOptions) -> Result<bool, String> {
    let program = match program_of(&options.file, &set_in(&options.more)) {
        Ok(program) => program,
        Err(error) if error.is_unreadable => return Err(error.to_string()),
        Err(error) => {
            // With standard error closed, there is no place left for the mistakes.
            let _ = writeln!(io::stderr(), "{error}");
            return Ok(false);
        }
    };
    let file = |path: &Path| fs::metadata(path).ok().map(|about| (about.dev(), about.ino()));
    let own = env::current_exe().ok().and_then(|own| file(&own));
    if own.is_some() && own == file(&program) {
        return Err(format!(
            "the program {} of the file is `blastema` itself: write the path of the robot's program",
            program.display()
        ));
    }
    let error = Command::new(&program).arg(command).arg(&options.file).args(&options.more).exec();
    Err(format!("the program {} of the file does not start: {error}: build it", program.display()))
}

/// The values of arguments among the options of a robot's program.
fn set_in(options: &[OsString]) -> Vec<(String, String)> {
    let (mut set, mut words) = (Vec::new(), options.iter().filter_map(|word| word.to_str()));
    while let Some(word) = words.next() {
        let written = if word == "--set" { words.next() } else { word.strip_prefix("--set=") };
        let parts = written.and_then(|written| written.split_once('='));
        set.extend(parts.map(|(name, value)| (name.to_owned(), value.to_owned())));
    }
    set
}

/// Writes a robot.
pub(crate) fn new(options: &NewOptions) -> Result<(), String> {
    let folder = &options.folder;
    let name = folder.file_name().and_then(|name| name.to_str()).unwrap_or_default();
    let is_package = name.starts_with(|c: char| c.is_ascii_lowercase())
        && name.chars().all(|c| c.is_ascii_lowercase() || c.is_ascii_digit() || c == '_');
    if !is_package || name.len() > 32 {
        return Err(format!(
            "{name:?} cannot be the name of a robot: write up to 32 small letters, digits and `_`, \
             the first a letter"
        ));
    }
    if TAKEN.split_whitespace().any(|taken| taken == name) {
        return Err(format!(
            "`{name}` cannot be the name of a robot, as its package is called so too: Rust, Cargo \
             or a dependency has taken it; write another one, as in `my_{name}`"
        ));
    }
    let sources = options.blastema.clone().unwrap_or_else(|| PathBuf::from(SOURCES));
    let sources = fs::canonicalize(&sources).ok().filter(|path| path.join("actors/robot").is_dir());
    let sources =
        sources.ok_or("write --blastema FOLDER, with the folder of Blastema's sources")?;
    fs::create_dir(folder).map_err(|error| {
        format!("{}: {error}: name a new folder, below one that there is", folder.display())
    })?;
    for (file, text) in FILES {
        let filled = |text: &str| {
            text.replace("{{name}}", name).replace("{{blastema}}", &sources.display().to_string())
        };
        write(&folder.join(filled(file)), &filled(text))?;
    }
    let folder = folder.display();
    print(&format!(
        "{folder} is a robot: cd {folder} && cargo test && cargo run -- run {name}.robot.xml\n"
    ))
}

fn write(path: &Path, text: &str) -> Result<(), String> {
    let made = path.parent().map_or(Ok(()), fs::create_dir_all);
    made.and_then(|()| fs::write(path, text))
        .map_err(|error| format!("{}: {error}", path.display()))
}
