//! The part of an endpoint string behind the question mark: pairs of keys and values.

use super::error::{Wrong, suggest};
use std::fmt;
use std::ops::RangeInclusive;
use std::time::Duration;

/// The settings of one endpoint string. Each is asked for by its key; a key that no transport has
/// asked for at the end is unknown.
pub(super) struct Settings<'a> {
    pairs: Vec<(&'a str, &'a str)>,
    asked: Vec<&'static str>,
}

impl<'a> Settings<'a> {
    /// Parts the query into pairs.
    pub(super) fn new(query: Option<&'a str>) -> Result<Self, Wrong<'a>> {
        let mut pairs: Vec<(&'a str, &'a str)> = Vec::new();
        for piece in query.into_iter().flat_map(|query| query.split('&')) {
            let (key, value) = piece.split_once('=').unwrap_or((piece, ""));
            if key.is_empty() {
                let problem = "the name of a setting is missing, as in ?mtu=1000";
                return Err(Wrong(key, problem.to_owned()));
            }
            if pairs.iter().any(|(known, _)| *known == key) {
                return Err(Wrong(key, format!("`{key}` is said twice: leave one of them out")));
            }
            pairs.push((key, value));
        }
        Ok(Settings { pairs, asked: Vec::new() })
    }

    /// The value of a key as `parse` reads it; `expected` says what it takes.
    pub(super) fn take<T>(
        &mut self,
        key: &'static str,
        expected: impl fmt::Display,
        parse: impl FnOnce(&str) -> Option<T>,
    ) -> Result<Option<T>, Wrong<'a>> {
        self.asked.push(key);
        let Some((key, value)) = self.pairs.iter().find(|(known, _)| *known == key) else {
            return Ok(None);
        };
        if value.is_empty() {
            return Err(Wrong(key, format!("`{key}` has no value: write {key}=…")));
        }
        let problem = || format!("`{key}` cannot be `{value}`: it takes {expected}");
        parse(value).map(Some).ok_or_else(|| Wrong(value, problem()))
    }

    /// A whole number, if one is given.
    pub(super) fn given<T: TryFrom<u64>>(
        &mut self,
        key: &'static str,
        range: RangeInclusive<u64>,
    ) -> Result<Option<T>, Wrong<'a>> {
        let expected = format!("a whole number from {} to {}", range.start(), range.end());
        self.take(key, expected, |text| {
            let number = text.parse().ok().filter(|number| range.contains(number))?;
            T::try_from(number).ok()
        })
    }

    /// Puts a whole number in place of `target`, if one is given.
    pub(super) fn number<T: TryFrom<u64>>(
        &mut self,
        key: &'static str,
        range: RangeInclusive<u64>,
        target: &mut T,
    ) -> Result<(), Wrong<'a>> {
        put(target, self.given(key, range)?);
        Ok(())
    }

    /// Puts yes or no in place of `target`, if one is given.
    pub(super) fn switch(&mut self, key: &'static str, target: &mut bool) -> Result<(), Wrong<'a>> {
        put(target, self.take(key, "true or false", |text| text.parse().ok())?);
        Ok(())
    }

    /// Whether a key is there that may stand without a value.
    pub(super) fn flag(&mut self, key: &'static str) -> Result<bool, Wrong<'a>> {
        if self.pairs.contains(&(key, "")) {
            self.asked.push(key);
            return Ok(true);
        }
        let mut given = false;
        self.switch(key, &mut given)?;
        Ok(given)
    }

    /// Puts a time of a millisecond to an hour in place of `target`, if one is given.
    pub(super) fn span(
        &mut self,
        key: &'static str,
        target: &mut Duration,
    ) -> Result<(), Wrong<'a>> {
        const RANGE: RangeInclusive<Duration> =
            Duration::from_millis(1)..=Duration::from_secs(3600);
        let parse = |text: &str| duration(text).filter(|span| RANGE.contains(span));
        put(target, self.take(key, "a time from 1ms to 3600s, as in 500ms or 2s", parse)?);
        Ok(())
    }

    /// Puts one of several words' meanings in place of `target`, if one is given.
    pub(super) fn choice<W: fmt::Display, T: Copy>(
        &mut self,
        key: &'static str,
        words: &[(W, T)],
        target: &mut T,
    ) -> Result<(), Wrong<'a>> {
        let names: Vec<String> = words.iter().map(|(word, _)| word.to_string()).collect();
        let parse = |text: &str| names.iter().position(|name| name == text);
        put(target, self.take(key, names.join(", "), parse)?.map(|at| words[at].1));
        Ok(())
    }

    /// Refuses a key that is given and does not go with another.
    pub(super) fn contradiction(&self, key: &str, why: &str) -> Result<(), Wrong<'a>> {
        let given = self.pairs.iter().find(|(known, _)| *known == key);
        given.map_or(Ok(()), |(key, _)| Err(Wrong(key, why.to_owned())))
    }

    /// Refuses the keys that no transport has asked for.
    pub(super) fn finish(self, medium: &str) -> Result<(), Wrong<'a>> {
        let unknown = self.pairs.iter().find(|(key, _)| !self.asked.contains(key));
        unknown.map_or(Ok(()), |(key, _)| {
            let hint = suggest(key, &self.asked);
            Err(Wrong(key, format!("{medium} has no key `{key}`: {hint}")))
        })
    }
}

fn put<T>(target: &mut T, value: Option<T>) {
    if let Some(value) = value {
        *target = value;
    }
}

pub(super) fn duration(text: &str) -> Option<Duration> {
    let (number, unit) = text.split_at(text.find(|c: char| !c.is_ascii_digit())?);
    let number = number.parse().ok()?;
    match unit {
        "us" => Some(Duration::from_micros(number)),
        "ms" => Some(Duration::from_millis(number)),
        "s" => Some(Duration::from_secs(number)),
        _ => None,
    }
}
