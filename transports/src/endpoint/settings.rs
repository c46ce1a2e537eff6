//! The part of an endpoint string behind the question mark: pairs of keys and values.

use super::error::{EndpointError, suggest};
use std::fmt;
use std::ops::{Range, RangeInclusive};
use std::time::Duration;

/// The settings of one endpoint string. Each is asked for by its key; a key that no transport has
/// asked for at the end is unknown.
pub(super) struct Settings<'a> {
    text: &'a str,
    medium: &'static str,
    pairs: Vec<Pair<'a>>,
    asked: Vec<&'static str>,
}

struct Pair<'a> {
    key: &'a str,
    key_at: Range<usize>,
    value: &'a str,
    value_at: Range<usize>,
}

/// Where `part`, a piece of `text`, begins there.
fn place(text: &str, part: &str) -> Range<usize> {
    let start = part.as_ptr() as usize - text.as_ptr() as usize;
    start..start + part.len()
}

impl<'a> Settings<'a> {
    /// Parts `query`, a piece of `text`, into pairs.
    pub(super) fn new(
        text: &'a str,
        medium: &'static str,
        query: Option<&'a str>,
    ) -> Result<Self, EndpointError> {
        let mut pairs: Vec<Pair<'a>> = Vec::new();
        for piece in query.into_iter().flat_map(|query| query.split('&')) {
            let (key, value) = piece.split_once('=').unwrap_or_else(|| piece.split_at(piece.len()));
            let (key_at, value_at) = (place(text, key), place(text, value));
            if key.is_empty() {
                let problem = "the name of a setting is missing, as in ?mtu=1000";
                return Err(EndpointError::new(text, key_at, problem));
            }
            if pairs.iter().any(|pair| pair.key == key) {
                let problem = format!("`{key}` is said twice: leave one of them out");
                return Err(EndpointError::new(text, key_at, problem));
            }
            pairs.push(Pair { key, key_at, value, value_at });
        }
        Ok(Settings { text, medium, pairs, asked: Vec::new() })
    }

    /// The value of a key as `parse` reads it; `expected` says what it takes.
    pub(super) fn take<T>(
        &mut self,
        key: &'static str,
        expected: impl fmt::Display,
        parse: impl FnOnce(&str) -> Option<T>,
    ) -> Result<Option<T>, EndpointError> {
        self.asked.push(key);
        let Some(pair) = self.pairs.iter().find(|pair| pair.key == key) else { return Ok(None) };
        if pair.value.is_empty() {
            let problem = format!("`{key}` has no value: write {key}=…");
            return Err(EndpointError::new(self.text, pair.key_at.clone(), problem));
        }
        parse(pair.value).map(Some).ok_or_else(|| {
            let problem = format!("`{key}` cannot be `{}`: it takes {expected}", pair.value);
            EndpointError::new(self.text, pair.value_at.clone(), problem)
        })
    }

    /// Puts a whole number in place of `target`, if one is given.
    pub(super) fn number<T>(
        &mut self,
        key: &'static str,
        range: RangeInclusive<u64>,
        target: &mut T,
    ) -> Result<(), EndpointError>
    where
        T: TryFrom<u64>,
    {
        let expected = format!("a whole number from {} to {}", range.start(), range.end());
        let parse = |text: &str| {
            let number = text.parse().ok().filter(|number| range.contains(number))?;
            T::try_from(number).ok()
        };
        put(target, self.take(key, expected, parse)?);
        Ok(())
    }

    /// Puts yes or no in place of `target`, if one is given.
    pub(super) fn switch(
        &mut self,
        key: &'static str,
        target: &mut bool,
    ) -> Result<(), EndpointError> {
        put(target, self.take(key, "true or false", |text| text.parse().ok())?);
        Ok(())
    }

    /// Whether a key is there that may stand without a value.
    pub(super) fn flag(&mut self, key: &'static str) -> Result<bool, EndpointError> {
        let is_bare = |pair: &Pair<'_>| pair.key == key && pair.value.is_empty();
        if self.pairs.iter().any(is_bare) {
            self.asked.push(key);
            return Ok(true);
        }
        let mut given = false;
        self.switch(key, &mut given)?;
        Ok(given)
    }

    /// Puts a time in place of `target`, if one is given.
    pub(super) fn span(
        &mut self,
        key: &'static str,
        range: RangeInclusive<Duration>,
        target: &mut Duration,
    ) -> Result<(), EndpointError> {
        let (least, most) = range.clone().into_inner();
        let expected = format!("a time from {least:?} to {most:?}, as in 500ms or 2s");
        let parse = |text: &str| duration(text).filter(|span| range.contains(span));
        put(target, self.take(key, expected, parse)?);
        Ok(())
    }

    /// One of several numbers.
    pub(super) fn one_of(
        &mut self,
        key: &'static str,
        known: &[u32],
    ) -> Result<Option<u32>, EndpointError> {
        let numbers: Vec<String> = known.iter().map(u32::to_string).collect();
        let parse = |text: &str| text.parse().ok().filter(|number| known.contains(number));
        self.take(key, numbers.join(", "), parse)
    }

    /// Puts one of several words' meanings in place of `target`, if one is given.
    #[cfg(feature = "serial")]
    pub(super) fn choice<T: Copy>(
        &mut self,
        key: &'static str,
        words: &[(&str, T)],
        target: &mut T,
    ) -> Result<(), EndpointError> {
        let names: Vec<&str> = words.iter().map(|(word, _)| *word).collect();
        let parse = |text: &str| words.iter().find(|(word, _)| *word == text).map(|(_, t)| *t);
        put(target, self.take(key, names.join(", "), parse)?);
        Ok(())
    }

    /// The name of an interface of the system.
    #[cfg(any(feature = "udp", feature = "tcp"))]
    pub(super) fn interface(&mut self) -> Result<Option<String>, EndpointError> {
        let expected = "the name of an interface, as in eth0: 1 to 15 letters without slash";
        self.take("interface", expected, |text| is_interface(text).then(|| text.to_owned()))
    }

    /// Whether a key is given.
    #[cfg(feature = "serial")]
    pub(super) fn has(&self, key: &str) -> bool {
        self.pairs.iter().any(|pair| pair.key == key)
    }

    /// An error at one of the keys that stand there, for what does not go with another.
    pub(super) fn contradiction(&self, key: &str, why: &'static str) -> EndpointError {
        let pair = self.pairs.iter().find(|pair| pair.key == key);
        let at = pair
            .map_or(self.text.len()..self.text.len(), |pair| pair.key_at.start..pair.value_at.end);
        EndpointError::new(self.text, at, why)
    }

    /// Refuses the keys that no transport has asked for.
    pub(super) fn finish(self) -> Result<(), EndpointError> {
        let Some(pair) = self.pairs.iter().find(|pair| !self.asked.contains(&pair.key)) else {
            return Ok(());
        };
        let hint = suggest(pair.key, &self.asked);
        let problem = format!("{} has no key `{}`: {hint}", self.medium, pair.key);
        Err(EndpointError::new(self.text, pair.key_at.clone(), problem))
    }
}

fn put<T>(target: &mut T, value: Option<T>) {
    if let Some(value) = value {
        *target = value;
    }
}

/// Whether Linux could call an interface so (`IFNAMSIZ` is 16 with its closing zero).
pub fn is_interface(text: &str) -> bool {
    let wrong = |c: char| c == '/' || c == ':' || c.is_whitespace() || c.is_control();
    (1..=15).contains(&text.len()) && text != "." && text != ".." && !text.contains(wrong)
}

fn duration(text: &str) -> Option<Duration> {
    let digits = text.find(|c: char| !c.is_ascii_digit())?;
    let (number, unit) = text.split_at(digits);
    let number: u64 = number.parse().ok()?;
    match unit {
        "us" => Some(Duration::from_micros(number)),
        "ms" => Some(Duration::from_millis(number)),
        "s" => Some(Duration::from_secs(number)),
        _ => None,
    }
}
