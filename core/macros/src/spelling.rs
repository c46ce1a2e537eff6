//! Finds the known word that a user may have meant to write.

/// The word of `known` that is nearest to `wrong`, if one is near enough to be meant.
pub(crate) fn nearest<'a>(wrong: &str, known: &[&'a str]) -> Option<&'a str> {
    let near = known.iter().map(|word| (strsim::osa_distance(wrong, word), *word)).min()?;
    // A third of the letters may be wrong, as in rustc's own suggestions.
    (near.0 <= wrong.chars().count().max(3) / 3).then_some(near.1)
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn the_nearest_word_is_found_unless_all_are_far() {
        let known = ["name", "version", "max_size", "max_age"];

        assert_eq!(nearest("nmae", &known), Some("name"));
        assert_eq!(nearest("maxsize", &known), Some("max_size"));
        assert_eq!(nearest("verison", &known), Some("version"));
        assert_eq!(nearest("colour", &known), None);
    }
}
