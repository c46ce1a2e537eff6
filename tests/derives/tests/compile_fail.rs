//! Wrong uses of the derives: each is refused, in words that say what to write instead. The right
//! uses are this package's program.
//!
//! Two of them are compiled, and with `BLASTEMA_LONG=1` all. After a change of the words, or of the
//! compiler, look at `BLASTEMA_LONG=1 TRYBUILD=overwrite cargo test -p blastema-derives` and at what
//! it changed.

#[test]
fn wrong_uses_of_the_derives_are_refused_in_words_that_help() {
    let cases = trybuild::TestCases::new();
    if std::env::var_os("BLASTEMA_LONG").is_some() {
        // Beside a case that passes, the others are compiled whole, not only checked: some errors
        // come that late.
        cases.pass("src/main.rs");
        cases.compile_fail("tests/compile_fail/*.rs");
    } else {
        for case in ["serde", "types"] {
            cases.compile_fail(format!("tests/compile_fail/{case}.rs"));
        }
    }
}
