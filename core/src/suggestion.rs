//! Finds the known word that a user may have meant to write.

/// The known word that is spelt most like `wrong`, unless none is like it at all.
///
/// ```
/// use blastema_core::suggestion::nearest;
///
/// assert_eq!(nearest("buad", ["baud", "parity"]), Some("baud"));
/// assert_eq!(nearest("colour", ["baud", "parity"]), None);
/// assert_eq!(nearest("", ["x"]), None);
/// ```
pub fn nearest<'a>(wrong: &str, known: impl IntoIterator<Item = &'a str>) -> Option<&'a str> {
    let (distance, word) = known
        .into_iter()
        .map(|word| (strsim::levenshtein(wrong, word), word))
        .min_by_key(|&(distance, _)| distance)?;
    // More than a third of the letters differ: that is another word, not a slip; and where nothing
    // is written, nothing is misspelt.
    (!wrong.is_empty() && distance <= 1 + wrong.len() / 3).then_some(word)
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn the_nearest_word_is_found_unless_all_are_far() {
        let known = ["interface", "baud", "mtu"];

        assert_eq!(nearest("inteface", known), Some("interface"));
        assert_eq!(nearest("bauds", known), Some("baud"));
        assert_eq!(nearest("stop_bits", known), None);
        assert_eq!(nearest("baud", []), None);
    }
}
