//! Finds the known word that a user may have meant to write.

/// The word of `known` that is nearest to `wrong`, if one is near enough to be meant.
pub(crate) fn nearest<'a>(wrong: &str, known: &[&'a str]) -> Option<&'a str> {
    let near = known.iter().map(|word| (distance(wrong, word), *word)).min()?;
    // A third of the letters may be wrong, as in rustc's own suggestions.
    (near.0 <= wrong.chars().count().max(3) / 3).then_some(near.1)
}

/// How many letters must be changed, left out or put in, or neighbours be exchanged, to turn one
/// word into the other (Damerau's distance, restricted form).
fn distance(from: &str, to: &str) -> usize {
    let (from, to): (Vec<char>, Vec<char>) = (from.chars().collect(), to.chars().collect());
    let mut rows = vec![(0..=to.len()).collect::<Vec<usize>>()];
    for i in 1..=from.len() {
        let mut row = vec![i];
        for j in 1..=to.len() {
            let same = usize::from(from[i - 1] != to[j - 1]);
            let mut best = (row[j - 1] + 1).min(rows[i - 1][j] + 1).min(rows[i - 1][j - 1] + same);
            if i > 1 && j > 1 && from[i - 1] == to[j - 2] && from[i - 2] == to[j - 1] {
                best = best.min(rows[i - 2][j - 2] + 1);
            }
            row.push(best);
        }
        rows.push(row);
    }
    rows[from.len()][to.len()]
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
