//! Stands for what a message carries along.

pub(crate) mod envelope {
    #[derive(Clone, Copy)]
    pub(crate) struct Times;
}
