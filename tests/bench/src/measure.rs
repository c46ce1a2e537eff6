//! Rows that are run in turn within one process, so that their ratios hold while the machine
//! drifts.

use std::time::Duration;

/// The median of some figures.
pub(crate) fn median(mut figures: Vec<f64>) -> f64 {
    figures.sort_by(f64::total_cmp);
    figures.get(figures.len() / 2).copied().unwrap_or(f64::NAN)
}

/// The spread of some durations.
#[derive(Default)]
pub(crate) struct Quantiles(Vec<Duration>);

impl Quantiles {
    pub(crate) fn add(&mut self, figure: Duration) {
        self.0.push(figure);
    }

    /// Prints the usual quantiles, in milliseconds.
    pub(crate) fn print(mut self, row: &str) {
        self.0.sort();
        let count = self.0.len();
        let at = |share: f64| {
            let rank = ((count as f64 * share).ceil() as usize).clamp(1, count.max(1)) - 1;
            self.0.get(rank).map_or(f64::NAN, |figure| figure.as_secs_f64() * 1e3)
        };
        let (middle, high, highest) = (at(0.5), at(0.99), at(1.0));
        println!("{row:<34} n {count:>6}  p50 {middle:>8.3}  p99 {high:>8.3}  max {highest:>8.3}");
    }
}

/// A table whose rows are measured in turn, round by round.
pub(crate) struct Table {
    title: String,
    unit: &'static str,
    rows: Vec<(String, Vec<f64>)>,
}

impl Table {
    /// An empty table.
    pub(crate) fn new(title: impl Into<String>, unit: &'static str) -> Self {
        Table { title: title.into(), unit, rows: Vec::new() }
    }

    /// Adds one round's figure to the row of that name.
    pub(crate) fn add(&mut self, row: &str, figure: f64) {
        match self.rows.iter_mut().find(|(name, _)| name == row) {
            Some((_, figures)) => figures.push(figure),
            None => self.rows.push((row.into(), vec![figure])),
        }
    }

    /// The median of the per-round ratios of one row to the first.
    pub(crate) fn ratio(&self, row: &str) -> f64 {
        let Some((_, first)) = self.rows.first() else { return f64::NAN };
        let Some((_, figures)) = self.rows.iter().find(|(name, _)| name == row) else {
            return f64::NAN;
        };
        median(figures.iter().zip(first).map(|(figure, first)| figure / first).collect())
    }

    /// Prints the table.
    pub(crate) fn print(&self) {
        let rounds = self.rows.first().map_or(0, |(_, figures)| figures.len());
        println!("\n## {} ({})", self.title, self.unit);
        println!("median of {rounds} rounds in turn [lowest..highest], ratio to the first row");
        for (name, figures) in &self.rows {
            let lowest = figures.iter().copied().fold(f64::MAX, f64::min);
            let highest = figures.iter().copied().fold(f64::MIN, f64::max);
            let (middle, ratio) = (median(figures.clone()), self.ratio(name));
            println!("{name:<52} {middle:>11.1}  [{lowest:.1}..{highest:.1}]  x{ratio:.2}");
        }
    }
}
