//! When a disk that failed is tried again.

use crate::types::NS_PER_S;

/// The second delay; each is twice as long as the one before.
const FIRST_DELAY_NS: u64 = NS_PER_S / 10;
const LAST_DELAY_NS: u64 = 5 * NS_PER_S;

/// At once the first time and whenever room could be made, then later and later.
#[derive(Debug, Default)]
pub struct Retry {
    /// In a row.
    failures: u32,
    at_ns: u64,
}

impl Retry {
    pub fn failed(&mut self, now_ns: u64, has_room_now: bool) {
        self.failures = self.failures.saturating_add(1);
        let delay_ns = match self.failures {
            1 => 0,
            _ if has_room_now => 0,
            failures => (FIRST_DELAY_NS << (failures - 2).min(16)).min(LAST_DELAY_NS),
        };
        self.at_ns = now_ns + delay_ns;
    }

    /// The disk works again.
    pub fn succeeded(&mut self) {
        self.failures = 0;
    }

    /// A last chance.
    pub fn at_once(&mut self) {
        self.at_ns = 0;
    }

    pub fn is_due(&self, now_ns: u64) -> bool {
        now_ns >= self.at_ns
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn delays_grow_until_it_works_again() {
        let mut retry = Retry::default();
        let mut delays_ms = |has_room: bool| {
            retry.failed(0, has_room);
            (0..).find(|ms| retry.is_due(ms * 1_000_000)).expect("some time")
        };
        assert_eq!([(); 4].map(|()| delays_ms(false)), [0, 100, 200, 400]);
        assert_eq!([delays_ms(true), delays_ms(false), delays_ms(false)], [0, 1600, 3200]);
        assert_eq!([(); 2].map(|()| delays_ms(false)), [5000, 5000]);
        retry.succeeded();
        retry.failed(7, false);
        assert!(retry.is_due(7) && !retry.is_due(6));
        retry.failed(7, false);
        retry.at_once();
        assert!(retry.is_due(0));
    }
}
