//! Wrong uses of the derives: each is refused, in words that say what to write instead. The right
//! uses are this package's program.
//!
//! After a change of the words, or of the compiler, look at `TRYBUILD=overwrite cargo test -p
//! blastema-derives` and at what it changed.

#[test]
fn wrong_uses_of_the_derives_are_refused_in_words_that_help() {
    let cases = trybuild::TestCases::new();
    // Beside a case that passes, the others are compiled whole, not only checked: some errors come
    // that late.
    cases.pass("src/main.rs");
    cases.compile_fail("tests/compile_fail/*.rs");
}
