//! Rows that are run in turn within one process, so that their ratios hold while the machine drifts.

/// The median of some figures.
pub(crate) fn median(mut figures: Vec<f64>) -> f64 {
    figures.sort_by(f64::total_cmp);
    figures.get(figures.len() / 2).copied().unwrap_or(f64::NAN)
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
