//! Losses in the log: the first of a kind at once, then what has gathered, now and then.

use std::collections::BTreeMap;

use crate::types::NS_PER_S;

/// Between two lines about the same kind of loss.
const INTERVAL_NS: u64 = 10 * NS_PER_S;

/// Counts losses by what and why until they are told.
#[derive(Debug, Default)]
pub struct Complaints {
    kinds: BTreeMap<(&'static str, &'static str), Kind>,
}

#[derive(Debug, Default)]
struct Kind {
    untold: u64,
    told_ns: Option<u64>,
}

impl Complaints {
    pub fn note(&mut self, topic: &'static str, reason: &'static str, count: u64) {
        self.kinds.entry((topic, reason)).or_default().untold += count;
    }

    /// Topic, reason and count of what is to be told now.
    pub fn due(&mut self, now_ns: u64) -> impl Iterator<Item = (&'static str, &'static str, u64)> {
        self.kinds.iter_mut().filter_map(move |(&(topic, reason), kind)| {
            let is_due = kind.told_ns.is_none_or(|told_ns| now_ns.saturating_sub(told_ns) >= INTERVAL_NS);
            (is_due && kind.untold > 0).then(|| {
                kind.told_ns = Some(now_ns);
                (topic, reason, std::mem::take(&mut kind.untold))
            })
        })
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn the_first_is_told_at_once_and_many_in_one_line() {
        let mut complaints = Complaints::default();
        let due = |complaints: &mut Complaints, second: u64| complaints.due(second * NS_PER_S).collect::<Vec<_>>();
        complaints.note("/gnss/fix", "jump", 1);
        assert_eq!(due(&mut complaints, 0), [("/gnss/fix", "jump", 1)]);
        for second in 1..10 {
            complaints.note("/gnss/fix", "jump", 2);
            assert_eq!(due(&mut complaints, second), []);
        }
        complaints.note("/gnss/fix", "speed", 1);
        assert_eq!(due(&mut complaints, 10), [("/gnss/fix", "jump", 18), ("/gnss/fix", "speed", 1)]);
        assert_eq!(due(&mut complaints, 100), [], "nothing has been lost since");
    }
}
