//! TOML tables that become settings, with a place for every complaint.

use serde::{Deserialize, de::DeserializeOwned};
use toml::{
    Spanned,
    de::{DeTable, DeValue, Deserializer},
};

/// A driver without settings.
#[derive(Deserialize)]
#[serde(deny_unknown_fields)]
pub(super) struct Nothing {}

/// What is wrong, and where in the text.
#[derive(Debug, Clone, PartialEq, Eq)]
pub struct Fault {
    /// Byte of the text.
    pub offset: usize,
    pub what: String,
}

impl Fault {
    pub fn new(offset: usize, what: impl Into<String>) -> Self {
        Self { offset, what: what.into() }
    }
}

impl From<toml::de::Error> for Fault {
    fn from(error: toml::de::Error) -> Self {
        Self::new(error.span().map_or(0, |span| span.start), in_plain_words(error.message()))
    }
}

/// Says what a deserializer found and expected in the words of the file, not of this program.
fn in_plain_words(message: &str) -> String {
    let message = message.trim_end().replace('\n', "; ");
    let mismatch = message.strip_prefix("invalid type: ").or_else(|| message.strip_prefix("invalid value: "));
    let Some((found, expected)) = mismatch.and_then(|mismatch| mismatch.split_once(", expected ")) else {
        return message;
    };
    let found = match found.split_once(' ') {
        Some(("integer" | "boolean", value)) => value.trim_matches('`').to_owned(),
        Some(("floating", value)) => value.trim_start_matches("point ").trim_matches('`').to_owned(),
        Some(("string", value)) => value.to_owned(),
        _ if found == "map" => "a table".to_owned(),
        _ if found == "sequence" => "a list".to_owned(),
        _ => found.to_owned(),
    };
    let expected = match expected {
        "u8" => "a whole number from 0 to 255",
        "u16" | "u32" | "u64" | "usize" => "a whole number that is not negative",
        "i8" | "i16" | "i32" | "i64" => "a whole number",
        "f32" | "f64" => "a number",
        "a boolean" => "true or false",
        "a string" => "a text in quotes",
        "path string" => "a path in quotes",
        _ => expected,
    };
    format!("is {found}, expected {expected}")
}

/// The tables of a file; each is taken out when it is read.
pub(super) struct Tables<'a> {
    root: DeTable<'a>,
}

impl<'a> Tables<'a> {
    pub fn parse(text: &'a str) -> Result<Self, Fault> {
        Ok(Self { root: DeTable::parse(text).map_err(Fault::from)?.into_inner() })
    }

    pub fn optional(&mut self, name: &'static str) -> Option<Table<'a>> {
        let (_, value) = self.root.remove_entry(name)?;
        Some(Table { name, value })
    }

    pub fn or_empty(&mut self, name: &'static str) -> Table<'a> {
        let empty = || Table { name, value: Spanned::new(0..0, DeValue::Table(DeTable::new())) };
        self.optional(name).unwrap_or_else(empty)
    }

    pub fn required(&mut self, name: &'static str) -> Result<Table<'a>, Fault> {
        self.optional(name).ok_or_else(|| Fault::new(0, format!("the table [{name}] is missing")))
    }

    /// `known`: what may be in the file.
    pub fn refuse_others(&self, known: &str) -> Result<(), Fault> {
        let Some((name, _)) = self.root.iter().next() else { return Ok(()) };
        let what = format!("unknown table or key `{}`, expected {known}", name.get_ref());
        Err(Fault::new(name.span().start, what))
    }
}

pub(super) struct Table<'a> {
    name: &'static str,
    value: Spanned<DeValue<'a>>,
}

impl<'a> Table<'a> {
    /// Takes the key `driver` out.
    pub fn driver(&mut self, known: &[&str]) -> Result<String, Fault> {
        let at = self.value.span().start;
        let expected = format!("expected one of \"{}\"", known.join("\", \""));
        let DeValue::Table(entries) = self.value.get_mut() else {
            return Err(Fault::new(at, format!("`{}` must be a table", self.name)));
        };
        let Some(driver) = entries.remove("driver") else {
            return Err(Fault::new(at, format!("[{}]: `driver` is missing, {expected}", self.name)));
        };
        let found = driver.get_ref().as_str().unwrap_or("not a text");
        if !known.contains(&found) {
            let what = format!("[{}]: driver is \"{found}\", {expected}", self.name);
            return Err(Fault::new(driver.span().start, what));
        }
        Ok(found.into())
    }

    /// A table of the same name with these keys, which this one then lacks.
    pub fn split_off(&mut self, keys: &[&str]) -> Self {
        let mut taken = DeTable::new();
        if let DeValue::Table(entries) = self.value.get_mut() {
            taken.extend(keys.iter().filter_map(|key| entries.remove_entry(*key)));
        }
        Self { name: self.name, value: Spanned::new(self.value.span(), DeValue::Table(taken)) }
    }

    pub fn read<T: DeserializeOwned>(self, check: impl FnOnce(&T) -> Result<(), String>) -> Result<T, Fault> {
        let at = self.value.span();
        let DeValue::Table(entries) = self.value.into_inner() else {
            return Err(Fault::new(at.start, format!("`{}` must be a table", self.name)));
        };
        let offsets: Vec<(String, usize)> =
            entries.iter().map(|(key, _)| (key.get_ref().to_string(), key.span().start)).collect();
        let in_table = |mut fault: Fault| {
            fault.offset = fault.offset.max(at.start);
            fault.what = format!("[{}]: {}", self.name, fault.what);
            fault
        };
        let settings = T::deserialize(Deserializer::from(Spanned::new(at.clone(), entries))).map_err(|error| {
            let mut fault = Fault::from(error);
            // A value of the wrong type: the key it belongs to is the last one before it.
            let key = offsets.iter().filter(|(_, offset)| *offset < fault.offset).max_by_key(|(_, offset)| *offset);
            if let (Some((key, _)), true) = (key, fault.what.starts_with("is ")) {
                fault.what = format!("{key} {}", fault.what);
            }
            in_table(fault)
        })?;
        check(&settings).map_err(|what| {
            // A complaint starts with the key it is about.
            let key = what.split_whitespace().next().unwrap_or_default().trim_matches('`');
            let offset = offsets.iter().find(|(name, _)| name == key).map_or(at.start, |&(_, offset)| offset);
            in_table(Fault::new(offset, what.clone()))
        })?;
        Ok(settings)
    }
}
