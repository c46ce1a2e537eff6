//! The blackboards of a tree: one for each subtree, in one arena.
//!
//! A key of a board means one entry for ever: a remapped key means an entry of the parent, any
//! other key one of its own board. So each key that the tree's files name is resolved once, and a
//! tick reads entries by number.

use crate::value::{PortType, PortValue, Value};
use std::collections::BTreeMap;
use std::sync::Arc;

/// The number of a board; the root's is 0.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq)]
pub(crate) struct BoardId(u32);

/// The number of an entry.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub(crate) struct KeyId(u32);

/// Scripts cannot make up keys, but `SetBlackboard` and the driver can: this many entries are a
/// thousand for each board of a large tree.
const MAX_KEYS: usize = 65_536;

/// The boards of a tree.
#[derive(Debug, Default)]
pub(crate) struct Blackboard {
    boards: Vec<Board>,
    entries: Vec<Entry>,
}

#[derive(Debug)]
struct Board {
    parent: Option<BoardId>,
    /// Keys that mean a key of the parent.
    remaps: BTreeMap<String, String>,
    /// Every other key means the parent's key of the same name.
    autoremap: bool,
    keys: BTreeMap<String, KeyId>,
}

#[derive(Debug)]
struct Entry {
    owner: BoardId,
    name: Arc<str>,
    /// A port declares it, or it has been written.
    exists: bool,
    /// None while the first value decides.
    kind: Option<PortType>,
    value: Option<Value>,
    /// The number of writes.
    writes: u64,
}

impl Blackboard {
    /// Adds a board; the first one is the root's.
    pub(crate) fn add(
        &mut self,
        parent: Option<BoardId>,
        remaps: BTreeMap<String, String>,
        autoremap: bool,
    ) -> BoardId {
        self.boards.push(Board { parent, remaps, autoremap, keys: BTreeMap::new() });
        BoardId(self.boards.len() as u32 - 1)
    }

    /// The root's board.
    pub(crate) const ROOT: BoardId = BoardId(0);

    /// The entry that the key means on this board. `@key` is the root's `key`.
    pub(crate) fn key(&mut self, board: BoardId, name: &str) -> KeyId {
        if let Some(name) = name.strip_prefix('@') {
            return self.key(Self::ROOT, name);
        }
        let here = &self.boards[board.0 as usize];
        if let Some(key) = here.keys.get(name) {
            return *key;
        }
        let key = match (here.parent, here.remaps.get(name)) {
            (Some(parent), Some(outer)) => {
                let outer = outer.clone();
                self.key(parent, &outer)
            }
            (Some(parent), None) if here.autoremap && !name.starts_with('_') => {
                self.key(parent, name)
            }
            _ => return self.own_key(board, name),
        };
        self.boards[board.0 as usize].keys.insert(name.to_owned(), key);
        key
    }

    /// The board's own entry of this name, whatever is remapped.
    pub(crate) fn own_key(&mut self, board: BoardId, name: &str) -> KeyId {
        let key = KeyId(self.entries.len() as u32);
        let name = Arc::from(name);
        let entry = Entry { owner: board, name, exists: false, kind: None, value: None, writes: 0 };
        self.boards[board.0 as usize].keys.insert(entry.name.to_string(), key);
        self.entries.push(entry);
        key
    }

    /// Whether no further key may be made up.
    pub(crate) fn is_full(&self) -> bool {
        self.entries.len() >= MAX_KEYS
    }

    /// The entry that the key means on the root's board, if the tree or the driver has named it.
    pub(crate) fn find(&self, name: &str) -> Option<KeyId> {
        self.boards[0].keys.get(name.strip_prefix('@').unwrap_or(name)).copied()
    }

    /// A port of this type uses the entry, which exists from now on.
    ///
    /// # Errors
    ///
    /// The other type that the entry has already.
    pub(crate) fn declare(&mut self, key: KeyId, kind: PortType) -> Result<(), PortType> {
        let entry = &mut self.entries[key.0 as usize];
        if !entry.exists {
            entry.exists = true;
            entry.kind = (!kind.is_any()).then_some(kind);
        }
        match entry.kind {
            // A text converts to whatever reads it.
            Some(known) if !kind.is_any() && known != kind && known != String::TYPE => Err(known),
            _ => Ok(()),
        }
    }

    /// The value, unless none has been written.
    pub(crate) fn value(&self, key: KeyId) -> Option<&Value> {
        self.entries[key.0 as usize].value.as_ref()
    }

    /// The name in the board that has the entry.
    pub(crate) fn name(&self, key: KeyId) -> Arc<str> {
        self.entries[key.0 as usize].name.clone()
    }

    /// Whether a port declares the entry, or it has been written.
    pub(crate) fn exists(&self, key: KeyId) -> bool {
        self.entries[key.0 as usize].exists
    }

    /// The type, unless the first value decides.
    pub(crate) fn kind(&self, key: KeyId) -> Option<PortType> {
        self.entries[key.0 as usize].kind
    }

    /// The number of writes; none if the entry does not exist.
    pub(crate) fn writes(&self, key: KeyId) -> Option<u64> {
        let entry = &self.entries[key.0 as usize];
        entry.exists.then_some(entry.writes)
    }

    /// Writes a value in the form that the entry keeps: that of its type, else of its first value.
    ///
    /// # Errors
    ///
    /// The value does not convert; the name of what the entry keeps.
    pub(crate) fn assign(&mut self, key: KeyId, value: Value) -> Result<(), &'static str> {
        let entry = &mut self.entries[key.0 as usize];
        let value = match (&entry.kind, &entry.value) {
            (Some(kind), _) => kind.admit(&value).ok_or(kind.name())?,
            (None, Some(Value::Int(_))) if matches!(value, Value::Int(_) | Value::Real(_)) => {
                Value::Int(value.as_int().ok_or("an integer")?)
            }
            (None, Some(Value::Int(_) | Value::Real(_))) => {
                Value::Real(value.as_real().ok_or("a number")?)
            }
            (None, Some(Value::Text(_))) if matches!(value, Value::Int(_) | Value::Real(_)) => {
                return Err("a text");
            }
            (None, _) => value,
        };
        entry.value = Some(value);
        entry.exists = true;
        entry.writes += 1;
        Ok(())
    }

    /// Writes a value of a known type, which a still untyped entry takes.
    pub(crate) fn set<T: PortValue>(&mut self, key: KeyId, value: T) -> Result<(), &'static str> {
        let entry = &mut self.entries[key.0 as usize];
        if entry.kind.is_none() {
            // The first text leaves the type open.
            let open = !entry.exists && T::TYPE == String::TYPE;
            entry.kind = (!open && !T::TYPE.is_any()).then_some(T::TYPE);
            entry.value = None;
        }
        self.assign(key, value.into_value())
    }

    /// Gives an entry that does not exist the type of another one.
    pub(crate) fn take_kind(&mut self, key: KeyId, from: KeyId) {
        let kind = self.entries[from.0 as usize].kind;
        let entry = &mut self.entries[key.0 as usize];
        if !entry.exists {
            entry.kind = kind;
        }
    }

    /// Removes the entry if the board has it itself. The number of writes goes on.
    pub(crate) fn erase(&mut self, board: BoardId, key: KeyId) {
        let entry = &mut self.entries[key.0 as usize];
        if entry.owner == board {
            (entry.exists, entry.kind, entry.value) = (false, None, None);
        }
    }
}
