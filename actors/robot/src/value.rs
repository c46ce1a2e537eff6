//! What the text of an attribute means.

use blastema::core::NameError;
use blastema::core::suggestion::nearest;
use blastema::recovery::RecoveryAction;
use blastema::{CommandTimeout, FaultKind, NodeName, ObjectName};
use std::time::Duration;

/// How many components `copies` may make.
const COPIES_MAX: usize = 1000;

/// Why a text is no value of a kind: the sentence, what to say at its place, and the help.
#[derive(Debug)]
pub(crate) struct ValueError {
    pub(crate) sentence: String,
    pub(crate) label: String,
    pub(crate) help: String,
}

impl ValueError {
    pub(crate) fn new(
        sentence: impl Into<String>,
        label: impl Into<String>,
        help: impl Into<String>,
    ) -> Self {
        ValueError { sentence: sentence.into(), label: label.into(), help: help.into() }
    }
}

/// What a text means.
pub(crate) type ParsedValue<T> = Result<T, ValueError>;

/// The nearest word, or all.
pub(crate) fn hint<'w>(wrong: &str, known: impl IntoIterator<Item = &'w str> + Clone) -> String {
    match nearest(wrong, known.clone()) {
        Some(near) => format!("write `{near}`"),
        None => match known.into_iter().take(10).collect::<Vec<_>>().join(", ") {
            all if all.is_empty() => "there is none".to_owned(),
            all => format!("there are {all}"),
        },
    }
}

fn wrong<T>(sentence: String, label: &str, help: impl Into<String>) -> ParsedValue<T> {
    Err(ValueError::new(sentence, label, help))
}

pub(crate) fn text(text: &str) -> ParsedValue<String> {
    Ok(text.to_owned())
}

/// A text that says something.
pub(crate) fn filled(text: &str) -> ParsedValue<String> {
    match text {
        "" => wrong("the value is empty".to_owned(), "a value", "write one"),
        text => Ok(text.to_owned()),
    }
}

pub(crate) fn words(text: &str) -> ParsedValue<Vec<String>> {
    Ok(text.split_whitespace().map(str::to_owned).collect())
}

/// A name, which `parse` checks.
fn name<T>(text: &str, parse: fn(&str) -> Result<T, NameError>) -> ParsedValue<String> {
    match parse(text) {
        Ok(_) => Ok(text.to_owned()),
        Err(error) => wrong(error.to_string(), "a name", "write another name"),
    }
}

pub(crate) fn node_name(text: &str) -> ParsedValue<String> {
    name(text, NodeName::new)
}

pub(crate) fn object_name(text: &str) -> ParsedValue<String> {
    name(text, ObjectName::new)
}

/// One of several words.
pub(crate) fn word<T: Clone>(what: &str, known: &[(&str, T)], text: &str) -> ParsedValue<T> {
    if let Some((_, meaning)) = known.iter().find(|(word, _)| *word == text) {
        return Ok(meaning.clone());
    }
    let words = known.iter().map(|(word, _)| *word);
    let all = words.clone().collect::<Vec<_>>().join(", ");
    let help = match nearest(text, words) {
        Some(word) => format!("write `{word}`; there are {all}"),
        None => format!("write one of {all}"),
    };
    wrong(format!("`{text}` is not {what}"), &format!("not {what}"), help)
}

/// The word of a value.
pub(crate) fn word_of<T: PartialEq>(words: &[(&'static str, T)], value: T) -> &'static str {
    words.iter().find(|(_, known)| *known == value).map_or("", |(word, _)| word)
}

pub(crate) fn flag(text: &str) -> ParsedValue<bool> {
    word("true or false", &[("true", true), ("false", false)], text)
}

/// A whole number.
pub(crate) fn count<T: TryFrom<u64>>(text: &str) -> ParsedValue<T> {
    let is_number = !text.is_empty() && text.bytes().all(|byte| byte.is_ascii_digit());
    let count = text.parse::<u64>().ok().and_then(|count| T::try_from(count).ok());
    match count.filter(|_| is_number) {
        Some(count) => Ok(count),
        None if is_number => {
            wrong(format!("`{text}` is too large"), "a whole number", "write less")
        }
        None => {
            let help = "write digits alone, without a unit";
            wrong(format!("`{text}` is not a whole number"), "a whole number", help)
        }
    }
}

pub(crate) fn number(text: &str) -> ParsedValue<f64> {
    match text.parse::<f64>() {
        Ok(number) if number.is_finite() => Ok(number),
        _ => wrong(format!("`{text}` is not a number"), "a number", "write a number"),
    }
}

/// A number and one of these units, each with its factor.
fn with_unit(what: &str, units: &[(&str, f64)], text: &str) -> ParsedValue<f64> {
    let end = text.find(|c: char| !(c.is_ascii_digit() || c == '.')).unwrap_or(text.len());
    let (digits, unit) = text.split_at(end);
    let factor = units.iter().find(|(known, _)| *known == unit);
    match (digits.parse::<f64>(), factor) {
        (Ok(number), Some((_, factor))) => Ok(number * factor),
        (Err(_), _) => {
            let help = format!("write a number and its unit, as in `100{}`", units[0].0);
            wrong(format!("`{text}` is not {what}"), what, help)
        }
        (Ok(_), None) if units.iter().any(|(known, _)| *known == unit.trim()) => {
            let help = format!("write `{digits}{}`", unit.trim());
            wrong(format!("{what} has no space"), what, help)
        }
        (Ok(_), None) => {
            let examples = units.iter().take(2).map(|(unit, _)| format!("`{digits}{unit}`"));
            let help = format!("write {}", examples.collect::<Vec<_>>().join(" or "));
            let sentence = match unit.trim() {
                "" => format!("`{text}` has no unit"),
                unit => format!("`{unit}` is no unit of {what}"),
            };
            wrong(sentence, what, help)
        }
    }
}

pub(crate) fn duration(text: &str) -> ParsedValue<Duration> {
    let units = [("ms", 1e-3), ("s", 1.0), ("us", 1e-6), ("ns", 1e-9), ("min", 60.0), ("h", 3.6e3)];
    let seconds = with_unit("a duration", &units, text)?;
    match Duration::try_from_secs_f64(seconds) {
        // Half a nanosecond is what a product of two floats is off at most.
        Ok(_) => Ok(Duration::from_nanos((seconds * 1e9).round() as u64)),
        Err(_) => wrong(format!("`{text}` is too long"), "a duration", "write less"),
    }
}

/// A duration, or `never`.
pub(crate) fn limit(text: &str) -> ParsedValue<Duration> {
    match text {
        "never" => Ok(Duration::MAX),
        text => duration(text),
    }
}

/// A duration, or `hold`.
pub(crate) fn command_timeout(text: &str) -> ParsedValue<CommandTimeout> {
    match text {
        "hold" => Ok(CommandTimeout::Hold),
        text => duration(text).map(CommandTimeout::After).map_err(|error| {
            let help = format!("{}, or `hold` for commands that run for long", error.help);
            ValueError { help, ..error }
        }),
    }
}

pub(crate) fn rate(text: &str) -> ParsedValue<f64> {
    with_unit("a rate", &[("Hz", 1.0), ("kHz", 1e3)], text)
}

/// A number of bytes.
pub(crate) fn size(text: &str) -> ParsedValue<u64> {
    let units = [("MiB", f64::from(1 << 20)), ("GiB", f64::from(1 << 30)), ("KiB", 1024.0)];
    // A float that is too large becomes the largest number.
    with_unit("a size", &units, text).map(|bytes| bytes as u64)
}

/// A kind of fault: its words with `-` between them, its code, or a code of the application's own.
pub(crate) fn fault(text: &str) -> ParsedValue<FaultKind> {
    let known = FaultKind::built_in().map(|kind| (fault_word(kind), kind));
    let known: Vec<_> = known.collect();
    let built_in = known.iter().find(|(word, kind)| word == text || kind.code() == text);
    if let Some((_, kind)) = built_in {
        return Ok((*kind).clone());
    }
    let mut letters = text.chars();
    let is_code = letters.next().is_some_and(|first| first.is_ascii_uppercase())
        && letters.all(|c| c.is_ascii_uppercase() || c.is_ascii_digit() || c == '_');
    if is_code {
        return Ok(FaultKind::Custom(text.into()));
    }
    let help = match nearest(text, known.iter().map(|(word, _)| word.as_str())) {
        Some(word) => format!("write `{word}`"),
        None => "write a kind of the manual's list of faults, as in `error-state` or `B05`, or a \
                 code of your own, as in `SLIP`"
            .to_owned(),
    };
    wrong(format!("`{text}` is no kind of fault"), "unknown", help)
}

/// What a robot file calls a kind of fault.
pub(crate) fn fault_word(kind: &FaultKind) -> String {
    match kind {
        FaultKind::Custom(code) => code.to_string(),
        kind => kind.text().replace(' ', "-"),
    }
}

/// An action of a plan; `strategy` stands for one that the application has registered.
pub(crate) fn action(text: &str) -> ParsedValue<Option<RecoveryAction>> {
    let actions = [
        ("observe", Some(RecoveryAction::Observe)),
        ("reset", Some(RecoveryAction::Reset)),
        ("restart", Some(RecoveryAction::Restart)),
        ("move-to-own-thread", Some(RecoveryAction::MoveToOwnThread)),
        ("reroute", Some(RecoveryAction::Reroute)),
        ("isolate", Some(RecoveryAction::Isolate)),
        ("safe-stop", Some(RecoveryAction::SafeStop)),
        ("strategy", None),
    ];
    word("an action", &actions, text)
}

/// The numbers of `00..33`, each as wide as the first is written.
pub(crate) fn copies(text: &str) -> ParsedValue<Vec<String>> {
    let numbers = text.split_once("..").and_then(|(first, last)| {
        let digits = |part: &str| part.len() <= 4 && part.bytes().all(|byte| byte.is_ascii_digit());
        let parsed = (first.parse::<usize>().ok()?, last.parse::<usize>().ok()?);
        (digits(first) && digits(last)).then_some((first.len(), parsed))
    });
    match numbers {
        Some((width, (first, last))) if first <= last && last - first < COPIES_MAX => {
            Ok((first..=last).map(|number| format!("{number:0width$}")).collect())
        }
        _ => {
            let help = "write the first and the last number, as in `00..33`: 1000 at most";
            wrong(format!("`{text}` are no numbers of copies"), "first..last", help)
        }
    }
}
