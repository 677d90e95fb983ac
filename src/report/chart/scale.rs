//! Axes: from values to pixels, and where their ticks are.

/// A stretch of values and the pixels it lies on.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct Scale {
    pub low: f64,
    pub high: f64,
    /// Logarithmic; `low` is positive.
    pub is_log: bool,
    /// Pixels of `low` and `high`.
    pub from_px: f64,
    pub to_px: f64,
}

/// A place on an axis and what is written there.
#[derive(Debug, Clone, PartialEq)]
pub struct Tick {
    pub value: f64,
    pub label: String,
}

impl Scale {
    /// Values from `low` to `high`; an empty stretch is widened.
    pub fn linear(low: f64, high: f64) -> Self {
        let (low, high) = if low.is_finite() && high.is_finite() { (low.min(high), low.max(high)) } else { (0.0, 1.0) };
        let (low, high) = if high - low > 1e-12 * (1.0 + low.abs()) { (low, high) } else { (low - 0.5, high + 0.5) };
        Self { low, high, is_log: false, from_px: 0.0, to_px: 1.0 }
    }

    /// Logarithmic, from a positive `low`.
    pub fn log(low: f64, high: f64) -> Self {
        let low = if low.is_finite() && low > 0.0 { low } else { 1e-3 };
        let high = if high.is_finite() && high > low { high } else { 10.0 * low };
        Self { low, high, is_log: true, from_px: 0.0, to_px: 1.0 }
    }

    pub fn onto(self, from_px: f64, to_px: f64) -> Self {
        Self { from_px, to_px, ..self }
    }

    /// The pixel of `value`. What a logarithmic axis cannot show lies at its low end.
    pub fn px(&self, value: f64) -> f64 {
        let share = if self.is_log {
            (value.max(self.low) / self.low).ln() / (self.high / self.low).ln()
        } else {
            (value - self.low) / (self.high - self.low)
        };
        self.from_px + share * (self.to_px - self.from_px)
    }

    /// Round values within the scale, about `wanted` of them.
    pub fn ticks(&self, wanted: usize) -> Vec<Tick> {
        if self.is_log { self.log_ticks(wanted) } else { self.linear_ticks(wanted) }
    }

    fn linear_ticks(&self, wanted: usize) -> Vec<Tick> {
        let step = round_step((self.high - self.low) / wanted.max(1) as f64);
        let decimals = (-step.log10().floor()).max(0.0) as usize;
        let first = (self.low / step - 1e-9).ceil();
        let last = (self.high / step + 1e-9).floor();
        let count = (last - first).clamp(-1.0, 100.0) as i64;
        (0..=count)
            .map(|i| {
                let value = (first + i as f64) * step;
                Tick { value, label: number(value, decimals) }
            })
            .collect()
    }

    fn log_ticks(&self, wanted: usize) -> Vec<Tick> {
        let (first, last) = (self.low.log10().floor() as i32, self.high.log10().ceil() as i32);
        let within = |value: &f64| (self.low * (1.0 - 1e-9)..=self.high * (1.0 + 1e-9)).contains(value);
        let of = |mantissas: &[f64]| -> Vec<f64> {
            let all = (first..=last).flat_map(|decade| mantissas.iter().map(move |m| m * 10.0_f64.powi(decade)));
            all.filter(within).collect()
        };
        let sets = [of(&[1.0, 2.0, 5.0]), of(&[1.0, 3.0]), of(&[1.0])];
        let fitting = sets.iter().find(|set| set.len() <= wanted + 2).unwrap_or(&sets[2]);
        let label = |&value: &f64| Tick { value, label: number(value, (-value.log10().floor()).max(0.0) as usize) };
        fitting.iter().map(label).collect()
    }
}

/// 1, 2 or 5 times a power of ten, at least `step`.
fn round_step(step: f64) -> f64 {
    let decade = 10.0_f64.powf(step.max(1e-12).log10().floor());
    let mantissa = [1.0, 2.0, 5.0, 10.0].into_iter().find(|m| m * decade >= step * (1.0 - 1e-9)).unwrap_or(10.0);
    mantissa * decade
}

/// `value` with so many decimals, a real minus sign and no negative zero; thousands set apart by thin spaces.
pub fn number(value: f64, decimals: usize) -> String {
    if !value.is_finite() {
        return "–".into();
    }
    let text = format!("{:.decimals$}", value.abs());
    let (whole, fraction) = text.split_once('.').unwrap_or((&text, ""));
    let mut grouped = String::new();
    for (i, digit) in whole.chars().enumerate() {
        if i > 0 && whole.len() > 4 && (whole.len() - i).is_multiple_of(3) {
            grouped.push('\u{a0}');
        }
        grouped.push(digit);
    }
    if !fraction.is_empty() {
        grouped.push('.');
        grouped += fraction;
    }
    let is_zero = text.chars().all(|c| matches!(c, '0' | '.'));
    if value < 0.0 && !is_zero { format!("−{grouped}") } else { grouped }
}

/// Metres with two decimals, above 10 with one.
pub fn meters(value_m: f64) -> String {
    number(value_m, if value_m.abs() < 9.995 { 2 } else { 1 })
}

#[cfg(test)]
mod tests {
    use super::*;

    fn labels(scale: Scale, wanted: usize) -> Vec<String> {
        scale.ticks(wanted).into_iter().map(|tick| tick.label).collect()
    }

    #[test]
    fn ticks_are_round_and_within() {
        assert_eq!(labels(Scale::linear(-3.0, 61.0), 5), ["0", "20", "40", "60"]);
        assert_eq!(labels(Scale::linear(0.0, 1.0), 5), ["0.0", "0.2", "0.4", "0.6", "0.8", "1.0"]);
        assert_eq!(labels(Scale::linear(-0.02, 0.02), 2), ["−0.02", "0.00", "0.02"]);
        assert_eq!(labels(Scale::log(0.1, 100.0), 6), ["0.1", "0.3", "1", "3", "10", "30", "100"]);
        assert_eq!(labels(Scale::log(0.5, 20.0), 6), ["0.5", "1", "2", "5", "10", "20"]);
        assert_eq!(labels(Scale::linear(0.0, 20_000.0), 2), ["0", "10\u{a0}000", "20\u{a0}000"]);
    }

    #[test]
    fn no_stretch_of_values_breaks_an_axis() {
        for scale in [
            Scale::linear(5.0, 5.0),
            Scale::linear(f64::NAN, 1.0),
            Scale::linear(1e12, 1e12),
            Scale::log(0.0, -1.0),
            Scale::log(f64::INFINITY, 1.0),
        ] {
            let scale = scale.onto(0.0, 100.0);
            assert!(scale.px(scale.low).abs() < 1e-9 && (scale.px(scale.high) - 100.0).abs() < 1e-6, "{scale:?}");
            assert!(scale.ticks(5).len() <= 12, "{scale:?}");
        }
        assert_eq!(Scale::log(0.1, 10.0).onto(0.0, 100.0).px(0.0), 0.0);
        assert!((Scale::log(0.1, 10.0).onto(0.0, 100.0).px(1.0) - 50.0).abs() < 1e-9);
    }

    #[test]
    fn numbers_read_well() {
        assert_eq!(number(-0.001, 2), "0.00");
        assert_eq!(number(-12.5, 1), "−12.5");
        assert_eq!(number(1_234_567.0, 0), "1\u{a0}234\u{a0}567");
        assert_eq!(number(f64::NAN, 2), "–");
        assert_eq!([meters(0.456), meters(12.34)], ["0.46", "12.3"]);
    }
}
