//! The program makes keys, changes the list of nodes, and never prints a secret.

use std::fs::{self, Permissions};
use std::os::unix::fs::PermissionsExt;
use std::path::{Path, PathBuf};
use std::process::Command;

/// A folder for one robot, and everything that the program has printed there.
struct Bench {
    folder: tempfile::TempDir,
    printed: String,
}

impl Bench {
    fn new() -> Self {
        Bench { folder: tempfile::tempdir().expect("a folder"), printed: String::new() }
    }

    fn at(&self, name: &str) -> PathBuf {
        self.folder.path().join(name)
    }

    fn text(&self, name: &str) -> String {
        fs::read_to_string(self.at(name)).expect(name)
    }

    /// Runs `blastema keys` there, and returns its exit status and what it printed.
    fn run(&mut self, arguments: &[&str]) -> (Option<i32>, String) {
        let output = Command::new(env!("CARGO_BIN_EXE_blastema"))
            .arg("keys")
            .args(arguments)
            .current_dir(self.folder.path())
            .output()
            .expect("the program can be started");
        let text = [output.stdout, output.stderr].concat();
        let text = String::from_utf8(text).expect("text");
        self.printed += &text;
        (output.status.code(), text)
    }

    fn done(&mut self, arguments: &[&str]) -> String {
        let (status, text) = self.run(arguments);
        assert_eq!(status, Some(0), "{arguments:?}: {text}");
        text
    }

    fn refused(&mut self, arguments: &[&str], words: &[&str]) {
        let (status, text) = self.run(arguments);
        assert_eq!(status, Some(2), "{arguments:?}: {text}");
        for word in words {
            assert!(text.contains(word), "{word:?} is not said in {text}");
        }
    }

    /// Every file with its text, in the order of the names.
    fn files(&self) -> Vec<(String, String)> {
        let mut files: Vec<_> = fs::read_dir(self.folder.path())
            .expect("it can be listed")
            .map(|entry| entry.expect("an entry").file_name().into_string().expect("a name"))
            .map(|name| (name.clone(), self.text(&name)))
            .collect();
        files.sort();
        files
    }
}

fn mode(path: &Path) -> u32 {
    fs::metadata(path).expect("it is there").permissions().mode() & 0o777
}

/// The secret of a file, as it stands there and in hexadecimal digits.
fn secrets(text: &str) -> Vec<String> {
    let seed = text.lines().find_map(|line| line.strip_prefix("seed    ")).expect("a secret");
    let alphabet = "ABCDEFGHIJKLMNOPQRSTUVWXYZabcdefghijklmnopqrstuvwxyz0123456789-_";
    let bits: String = seed
        .chars()
        .map(|letter| format!("{:06b}", alphabet.find(letter).expect("base64url")))
        .collect();
    let nibble = |place: usize| u8::from_str_radix(&bits[place * 4..place * 4 + 4], 2).unwrap();
    let hex: String = (0..64).map(|place| format!("{:x}", nibble(place))).collect();
    let ordinary = seed.replace('-', "+").replace('_', "/");
    vec![seed.to_owned(), ordinary, hex.to_uppercase(), hex]
}

#[test]
fn keys_are_made_changed_and_shown_without_any_secret() {
    let _turn = blastema_doubles::turn();
    let mut bench = Bench::new();
    let made = bench.done(&["new", "ranger", "base", "arm", "laptop", "--role", "laptop=operator"]);
    assert!(made.contains("ranger.roster beside it: .keys(\"base.key\")\n"), "{made}");
    for (name, expected) in [
        ("ranger.robot", 0o600),
        ("base.key", 0o600),
        ("arm.key", 0o600),
        ("laptop.key", 0o600),
        ("ranger.roster", 0o644),
    ] {
        assert_eq!(mode(&bench.at(name)), expected, "{name}");
    }
    assert_eq!(bench.files().len(), 5, "nothing else is left");
    let mut secret: Vec<String> = Vec::new();
    for name in ["ranger.robot", "base.key", "arm.key", "laptop.key"] {
        let found = secrets(&bench.text(name));
        assert!(!secret.contains(&found[0]), "each has its own");
        secret.extend(found);
    }

    let shown = bench.done(&["show"]);
    for part in ["robot ranger", "serial 1", "base.key: node base", "laptop  operator", "signed by"]
    {
        assert!(shown.contains(part), "{part} is missing in\n{shown}");
    }
    let alone = bench.done(&["show", "ranger.roster"]);
    assert!(alone.contains("the signature is not checked"), "{alone}");

    bench.done(&["add", "gripper", "--role", "gripper=guest"]);
    secret.extend(secrets(&bench.text("gripper.key")));
    assert!(bench.text("ranger.roster").contains("serial  2\n"));
    fs::rename(bench.at("arm.key"), bench.at("arm.key.old")).expect("it can be moved");
    bench.done(&["replace", "arm", "--robot", "ranger.robot"]);
    assert_ne!(bench.text("arm.key"), bench.text("arm.key.old"));
    secret.extend(secrets(&bench.text("arm.key")));

    let signed = bench.text("ranger.roster");
    let body = &signed[..signed.find("signed").expect("a signature")];
    let edited = body
        .replace(" role operator", "")
        .replace("end\n", "policy\n  only base may lease on base/**\nend\n");
    fs::write(bench.at("text"), edited).expect("it can be written");
    // What an editor has left after a mistake is removed once it is right, another file is not.
    fs::copy(bench.at("text"), bench.at("ranger.edited")).expect("a copy");
    bench.refused(&["edit"], &["run `blastema keys edit --from ranger.edited`, or remove it"]);
    bench.done(&["edit", "--from", "ranger.edited"]);
    assert!(!bench.at("ranger.edited").exists() && bench.at("text").exists());
    let shown = bench.done(&["show"]);
    assert!(shown.contains("policy 1: only base may lease on base/**"), "{shown}");
    assert!(shown.contains("serial 4") && !shown.contains("operator"), "{shown}");

    bench.refused(&["revoke", "base"], &["line 1 of the policy names base alone"]);
    bench.done(&["revoke", "laptop"]);
    let shown = bench.done(&["show", "ranger.robot", "ranger.roster"]);
    assert!(!shown.contains("laptop") && shown.contains("serial 5"), "{shown}");

    bench.refused(&["show", "text"], &["text ends in none of .robot, .key and .roster"]);
    let printed = bench.printed + &bench.folder.path().display().to_string();
    for secret in secret {
        assert!(!printed.contains(&secret), "a secret was printed");
    }
}

#[test]
fn nothing_is_overwritten_and_what_is_wrong_changes_no_file() {
    let _turn = blastema_doubles::turn();
    let mut bench = Bench::new();
    bench.done(&["new", "ranger", "base", "arm"]);
    fs::copy(bench.at("ranger.robot"), bench.at("old")).expect("a copy");
    bench.done(&["add", "head"]);
    let before = bench.files();

    bench.refused(&["new", "ranger", "base"], &["ranger.robot is there already: move"]);
    bench.refused(&["new", "rover", "base"], &["base.key is there already: move"]);
    bench.refused(&["replace", "arm"], &["arm.key is there already: move"]);
    bench.refused(&["add", "base"], &["node base is listed twice"]);
    bench.refused(&["add", "costarring", "liquid"], &["liquid: ", "as costarring has"]);
    bench.refused(&["add", "x", "--role", "y=guest"], &["y is none of the nodes"]);
    bench.refused(&["add", "x", "--role", "x=gest"], &["did you mean `guest`?"]);
    bench.refused(&["revoke", "leg"], &["leg is not listed: the nodes are base, arm, head"]);
    bench.refused(&["replace", "leg"], &["leg is not listed"]);
    // An old copy of the signer's file would make a second list of serial 2.
    bench.refused(&["add", "leg", "--robot", "old"], &["has serial 2", "it is an old copy"]);
    let other = bench.text("ranger.roster").replace("\nend\n", "\nend\nmore\n");
    fs::write(bench.at("text"), other).expect("it can be written");
    bench.refused(&["edit", "--from", "text"], &["text: line 8", "keys edit --from text"]);
    fs::remove_file(bench.at("text")).expect("it is there");

    assert_eq!(bench.files(), before);
}

#[test]
fn a_secret_that_others_can_read_is_refused_with_the_command_that_mends_it() {
    let _turn = blastema_doubles::turn();
    let mut bench = Bench::new();
    bench.done(&["new", "ranger", "base"]);
    for (name, arguments) in
        [("base.key", &["show", "base.key"][..]), ("ranger.robot", &["add", "arm"])]
    {
        fs::set_permissions(bench.at(name), Permissions::from_mode(0o644)).expect("it is ours");
        let cure = format!("chmod 600 {name}");
        bench.refused(arguments, &["can be read by others (mode 0644)", &cure]);
        fs::set_permissions(bench.at(name), Permissions::from_mode(0o600)).expect("it is ours");
        bench.done(arguments);
    }
    fs::set_permissions(bench.folder.path(), Permissions::from_mode(0o777)).expect("it is ours");
    bench.refused(&["show", "base.key"], &["can write to its folder (mode 0777): chmod go-w ."]);
}

#[test]
fn the_help_says_what_nodes_do_with_keys() {
    let _turn = blastema_doubles::turn();
    let mut bench = Bench::new();
    for command in ["new", "show", "add", "revoke", "replace", "edit"] {
        let help = bench.done(&[command, "--help"]);
        assert!(help.contains(".keys(\"base.key\")") && help.contains("BLASTEMA_KEYS"), "{help}");
        assert!(help.contains("ROBOT.roster again when it is replaced"), "{help}");
        assert!(help.contains("Exit status"), "{help}");
        let changes = !["new", "show"].contains(&command);
        assert_eq!(help.contains("--push <NODE@ADDRESS>"), changes, "{help}");
        assert!(bench.done(&["--help"]).contains(command));
    }
}
