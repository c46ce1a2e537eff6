//! Wrong uses of the derives: each is refused, in words that say what to write instead.
//!
//! After a change of the words, or of the compiler, look at `TRYBUILD=overwrite cargo test -p
//! blastema-tests --test compile_fail` and at what it changed.

#[test]
fn wrong_uses_of_the_derives_are_refused_in_words_that_help() {
    let cases = trybuild::TestCases::new();
    cases.pass("tests/compile_pass/right_uses.rs");
    cases.compile_fail("tests/compile_fail/*.rs");
}
