//! `blastema fault`: the list of faults, of running nodes or of a journal that outlived them.

mod list;

pub(crate) use self::list::run;
