//! What may stand in `#[contract(..)]`.

use crate::spelling::nearest;
use syn::meta::ParseNestedMeta;
use syn::spanned::Spanned;
use syn::{Attribute, Error, Expr, Ident, LitInt, LitStr, Path, Result, Type, parse_quote};

/// The longest name of a contract in bytes, as for objects.
const NAME_LIMIT: usize = 128;
/// The longest unit or frame in bytes; a description with a longer one is not taken by a peer.
const TEXT_LIMIT: usize = 128;

const TYPE_KEYS: &[&str] = &[
    "name",
    "version",
    "from",
    "max_size",
    "max_age",
    "delivery",
    "idempotent",
    "latched",
    "bulk",
    "when_full",
    "reply",
    "crate",
];
/// How a contract's messages may travel, and the variant that says so.
const DELIVERIES: &[(&str, &str)] =
    &[("reliable", "Reliable"), ("newest", "Newest"), ("redundant", "Redundant")];
const FIELD_KEYS: &[&str] = &["unit", "frame", "at_most"];

/// Which derive reads the attributes.
#[derive(Clone, Copy, PartialEq, Eq)]
pub(crate) enum Derive {
    Structure,
    Event,
    Request,
    Variable,
}

/// What `#[contract(..)]` says about a type.
pub(crate) struct TypeAttributes {
    pub(crate) name: Option<LitStr>,
    pub(crate) version: Option<u16>,
    pub(crate) max_size: Option<Expr>,
    pub(crate) max_age_nanos: Option<u64>,
    pub(crate) reply: Option<Type>,
    /// The version before.
    pub(crate) from: Option<Type>,
    /// A variant of `Delivery`.
    pub(crate) delivery: Option<Ident>,
    /// The constants of the contract that are true.
    pub(crate) flags: Vec<Ident>,
    /// Where the facade is to be found.
    pub(crate) facade: Path,
}

/// What `#[contract(..)]` says about a field.
#[derive(Default)]
pub(crate) struct FieldAttributes {
    pub(crate) unit: Option<LitStr>,
    pub(crate) frame: Option<LitStr>,
    /// How many bytes or elements there may be.
    pub(crate) at_most: Option<LitInt>,
}

impl TypeAttributes {
    pub(crate) fn parse(attributes: &[Attribute], derive: Derive) -> Result<Self> {
        refuse_serde(attributes)?;
        let mut parsed = TypeAttributes {
            name: None,
            version: None,
            max_size: None,
            max_age_nanos: None,
            reply: None,
            from: None,
            delivery: None,
            flags: Vec::new(),
            facade: parse_quote!(::blastema),
        };
        for_each_key("contract", attributes, |meta, key| {
            if let Some(reason) = misplaced(key, derive) {
                return Err(meta.error(reason));
            }
            match key {
                "name" => parsed.name = Some(parse_name(&meta)?),
                "version" => parsed.version = Some(parse_version(&meta)?),
                "max_size" => parsed.max_size = Some(meta.value()?.parse()?),
                "max_age" => parsed.max_age_nanos = Some(parse_nanos(&meta.value()?.parse()?)?),
                "from" => parsed.from = Some(meta.value()?.parse()?),
                "delivery" => parsed.delivery = Some(parse_delivery(&meta, derive)?),
                "idempotent" => parsed.flags.push(parse_quote!(IDEMPOTENT)),
                "latched" => parsed.flags.push(parse_quote!(LATCHED)),
                "bulk" => parsed.flags.push(parse_quote!(BULK)),
                "when_full" if parse_when_full(&meta)? => {
                    parsed.flags.push(parse_quote!(REFUSE_WHEN_FULL));
                }
                "when_full" => {}
                "reply" => parsed.reply = Some(meta.value()?.parse()?),
                "crate" => parsed.facade = meta.value()?.parse::<LitStr>()?.parse()?,
                _ => return Err(unknown(&meta, key, TYPE_KEYS)),
            }
            Ok(())
        })?;
        Ok(parsed)
    }
}

impl FieldAttributes {
    pub(crate) fn parse(attributes: &[Attribute]) -> Result<Self> {
        refuse_serde(attributes)?;
        let mut parsed = FieldAttributes::default();
        for_each_key("contract", attributes, |meta, key| {
            if TYPE_KEYS.contains(&key) {
                return Err(meta.error(format!("`{key}` belongs above the type, not to a field")));
            }
            match key {
                "unit" => parsed.unit = Some(parse_text(&meta, key)?),
                "frame" => parsed.frame = Some(parse_text(&meta, key)?),
                "at_most" => parsed.at_most = Some(parse_bound(&meta)?),
                _ => return Err(unknown(&meta, key, FIELD_KEYS)),
            }
            Ok(())
        })?;
        Ok(parsed)
    }
}

/// Refuses everything on a variant itself, where nothing can be declared.
pub(crate) fn refuse_on_variant(attributes: &[Attribute]) -> Result<()> {
    refuse_serde(attributes)?;
    for_each_key("contract", attributes, |meta, key| {
        Err(meta
            .error(format!("`{key}` cannot stand on a variant: put it on a field or on the type")))
    })
}

/// Reads the arguments of `#[main(..)]` and `#[test(..)]`: at most `crate = ".."`.
pub(crate) fn parse_crate(meta: &ParseNestedMeta<'_>, facade: &mut Path) -> Result<()> {
    if !meta.path.is_ident("crate") {
        return Err(meta.error("unknown key: only `crate = \"path\"` is known here"));
    }
    *facade = meta.value()?.parse::<LitStr>()?.parse()?;
    Ok(())
}

/// Takes each key of the attributes of this name, once.
pub(crate) fn for_each_key(
    name: &str,
    attributes: &[Attribute],
    mut take: impl FnMut(ParseNestedMeta<'_>, &str) -> Result<()>,
) -> Result<()> {
    let mut seen = Vec::new();
    for attribute in attributes.iter().filter(|a| a.path().is_ident(name)) {
        attribute.parse_nested_meta(|meta| {
            let key = match meta.path.get_ident() {
                Some(ident) => ident.to_string(),
                None => return Err(meta.error("a key is a single word")),
            };
            if seen.contains(&key) {
                return Err(meta.error(format!("`{key}` is given twice")));
            }
            seen.push(key.clone());
            take(meta, &key)
        })?;
    }
    Ok(())
}

fn misplaced(key: &str, derive: Derive) -> Option<String> {
    let reason = match (key, derive) {
        ("unit" | "frame" | "at_most", _) => {
            return Some(format!("`{key}` belongs to a field, not above the type"));
        }
        (key, Derive::Structure) if key != "crate" && TYPE_KEYS.contains(&key) => {
            return Some(format!(
                "a structure is part of contracts and has none of its own: derive `Event` or \
                 `Request` instead, or remove `{key}`"
            ));
        }
        ("reply", Derive::Event) => {
            "an event has no reply: derive `Request` instead, or remove `reply`"
        }
        ("reply", Derive::Variable) => {
            "a variable has no reply: it is read and written; remove `reply`"
        }
        ("max_age", Derive::Variable) => {
            "a variable shows its age to its readers; remove `max_age`"
        }
        ("idempotent", Derive::Event) => {
            "an event is not answered, so that no caller waits or sends it again: remove `idempotent`"
        }
        ("latched", Derive::Request) => {
            "only the last event of a topic can be kept for later listeners: remove `latched`"
        }
        ("latched", Derive::Variable) => {
            "a variable gives its value to each reader: remove `latched`"
        }
        ("when_full", Derive::Request | Derive::Variable) => {
            "only an event is published: remove `when_full`"
        }
        ("bulk", Derive::Variable) => {
            "a variable travels in messages of the middleware: remove `bulk`"
        }
        _ => return None,
    };
    Some(reason.to_owned())
}

pub(crate) fn unknown(meta: &ParseNestedMeta<'_>, key: &str, known: &[&str]) -> Error {
    let hint = match nearest(key, known) {
        Some(word) => format!("did you mean `{word}`?"),
        None => format!("the keys here are `{}`", known.join("`, `")),
    };
    meta.error(format!("unknown key `{key}`: {hint}"))
}

fn parse_version(meta: &ParseNestedMeta<'_>) -> Result<u16> {
    let literal: LitInt = meta.value()?.parse()?;
    literal.base10_parse().map_err(|_| {
        Error::new(literal.span(), "a version is a whole number from 0 to 65535, such as `2`")
    })
}

/// Reads how messages travel; answers the variant.
fn parse_delivery(meta: &ParseNestedMeta<'_>, derive: Derive) -> Result<Ident> {
    let literal: LitStr = meta.value()?.parse()?;
    let text = literal.value();
    if derive == Derive::Request && text == "newest" {
        let reason =
            "every request is answered: write `reliable` or `redundant`, or derive `Event`";
        return Err(Error::new(literal.span(), reason));
    }
    let known = DELIVERIES.iter().find(|(word, _)| *word == text);
    known.map(|(_, variant)| Ident::new(variant, literal.span())).ok_or_else(|| {
        let words: Vec<_> = DELIVERIES.iter().map(|(word, _)| *word).collect();
        let hint = match nearest(&text, &words) {
            Some(word) => format!("did you mean `{word}`?"),
            None => format!("it is one of `{}`", words.join("`, `")),
        };
        Error::new(literal.span(), format!("unknown delivery `{text}`: {hint}"))
    })
}

/// Reads what becomes of an event for which another node has no capacity; answers whether it is
/// refused.
fn parse_when_full(meta: &ParseNestedMeta<'_>) -> Result<bool> {
    let literal: LitStr = meta.value()?.parse()?;
    match literal.value().as_str() {
        "drop" => Ok(false),
        "refuse" => Ok(true),
        other => {
            let reason = format!("unknown `when_full` `{other}`: it is one of `drop`, `refuse`");
            Err(Error::new(literal.span(), reason))
        }
    }
}

/// Reads the name of a contract.
fn parse_name(meta: &ParseNestedMeta<'_>) -> Result<LitStr> {
    let literal: LitStr = meta.value()?.parse()?;
    match wrong_name(&literal.value()) {
        None => Ok(literal),
        Some(reason) => Err(Error::new(literal.span(), reason)),
    }
}

/// What is wrong with a contract's name, which obeys the rules for names of objects.
pub(crate) fn wrong_name(name: &str) -> Option<String> {
    // Paths of files and command lines take such a part for a folder or an option.
    let is_mistaken = |part: &&str| *part == "." || *part == ".." || part.starts_with('-');
    let wrong = |c: &char| !(c.is_ascii_alphanumeric() || "_-./".contains(*c));
    if name.split('/').any(str::is_empty) {
        Some("a contract's name, or a part of it between slashes, is empty".into())
    } else if name.len() > NAME_LIMIT {
        Some(format!("a contract's name has at most {NAME_LIMIT} bytes"))
    } else if let Some(part) = name.split('/').find(is_mistaken) {
        Some(format!(
            "a part of a contract's name is not '.' or '..', and begins with no '-': not {part:?}"
        ))
    } else {
        let c = name.chars().find(wrong)?;
        Some(format!(
            "a contract's name takes ASCII letters, digits, '_', '-', '.' and '/', but not {c:?}"
        ))
    }
}

/// Reads how many there may be.
fn parse_bound(meta: &ParseNestedMeta<'_>) -> Result<LitInt> {
    let bound: LitInt = meta.value()?.parse()?;
    match bound.base10_parse::<u32>() {
        Ok(1..) if bound.suffix().is_empty() => Ok(bound),
        _ => Err(Error::new(bound.span(), "`at_most` is a whole number from 1, such as 16")),
    }
}

/// Reads a unit or a frame.
pub(crate) fn parse_text(meta: &ParseNestedMeta<'_>, key: &str) -> Result<LitStr> {
    let literal: LitStr = meta.value()?.parse()?;
    let text = literal.value();
    let reason = if text.trim().is_empty() || text.trim() != text {
        "is empty, or has blanks around it".into()
    } else if text.len() > TEXT_LIMIT {
        format!("has more than {TEXT_LIMIT} bytes")
    } else if text.chars().any(char::is_control) {
        "holds a control character".into()
    } else {
        return Ok(literal);
    };
    Err(Error::new(literal.span(), format!("`{key}` {reason}")))
}

/// Reads a span of time such as `100ms`.
fn parse_nanos(literal: &LitStr) -> Result<u64> {
    let text = literal.value();
    let digits = text.find(|c: char| !c.is_ascii_digit()).unwrap_or(text.len());
    let (number, unit) = text.split_at(digits);
    let nanos_each: Option<u64> = match unit.trim_start() {
        "ns" => Some(1),
        "us" | "µs" => Some(1_000),
        "ms" => Some(1_000_000),
        "s" => Some(1_000_000_000),
        "min" => Some(60_000_000_000),
        "h" => Some(3_600_000_000_000),
        _ => None,
    };
    nanos_each
        .zip(number.parse::<u64>().ok())
        .and_then(|(each, number)| number.checked_mul(each))
        .filter(|&nanos| nanos > 0)
        .ok_or_else(|| {
            let hint =
                "a span of time above zero is a whole number and one of ns, us, ms, s, min, h";
            Error::new(literal.span(), format!("{hint}, such as `100ms`"))
        })
}

fn refuse_serde(attributes: &[Attribute]) -> Result<()> {
    let Some(attribute) = attributes.iter().find(|a| a.path().is_ident("serde")) else {
        return Ok(());
    };
    Err(Error::new(
        attribute.path().span(),
        "a contract's bytes carry no names, so that serde's attributes either change nothing or make \
         a message that cannot be read back: remove it, and write the type as it is to be sent, with \
         an `Option` for what may be missing, and a plain enum, whose variants are numbered",
    ))
}
