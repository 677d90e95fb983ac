//! What was found and what was lost, channel by channel.

use std::{collections::BTreeMap, ops::Range};

use mcap::records::{MessageHeader, Record, op};

use super::{LostSpan, Recovery};
use crate::recording::{reader::TopicSummary, records::parse};

/// A larger jump of the sequence numbers is a new count, not a loss.
const MAX_GAP: u32 = 100_000;

#[derive(Default)]
pub(super) struct Ledger {
    recovery: Recovery,
    channels: BTreeMap<u16, Channel>,
    last_log_ns: Option<u64>,
}

struct Channel {
    topic: String,
    schema_name: String,
    last_sequence: Option<u32>,
    /// Something was lost since the last message.
    behind_loss: bool,
    /// Messages of it that were found damaged since then.
    damaged: u64,
}

impl Ledger {
    /// A channel; one that was declared before stays as it is.
    pub fn declare(&mut self, id: u16, topic: String, schema_name: String) {
        let channel = Channel { topic, schema_name, last_sequence: None, behind_loss: false, damaged: 0 };
        self.channels.entry(id).or_insert(channel);
    }

    /// `None`: no such channel was declared.
    pub fn schema_name(&self, channel_id: u16) -> Option<&str> {
        self.channels.get(&channel_id).map(|channel| channel.schema_name.as_str())
    }

    pub fn has_losses(&self) -> bool {
        self.recovery.lost_bytes > 0
    }

    /// The recording has its end.
    pub fn note_end(&mut self) {
        self.recovery.reached_the_end = true;
    }

    /// A whole message of a declared channel.
    pub fn note_message(&mut self, header: &MessageHeader) {
        let (recovery, stamp_ns) = (&mut self.recovery, header.log_time);
        recovery.messages += 1;
        let channel = self.channels.get_mut(&header.channel_id).expect("the caller looked it up");
        match recovery.topics.get_mut(&channel.topic) {
            Some(topic) => {
                topic.messages += 1;
                topic.first_ns = topic.first_ns.min(stamp_ns);
                topic.last_ns = topic.last_ns.max(stamp_ns);
            }
            None => {
                let schema_name = channel.schema_name.clone();
                let first = TopicSummary { schema_name, messages: 1, first_ns: stamp_ns, last_ns: stamp_ns };
                recovery.topics.insert(channel.topic.clone(), first);
            }
        }
        if let Some(span) = recovery.spans.last_mut()
            && span.before_ns.is_none()
        {
            span.before_ns = Some(stamp_ns);
        }
        self.last_log_ns = Some(stamp_ns);
        if channel.behind_loss {
            let after_last = channel.last_sequence.and_then(|last| header.sequence.checked_sub(last)?.checked_sub(1));
            let skipped = after_last.filter(|&gap| gap <= MAX_GAP).unwrap_or(0);
            let lost = u64::from(skipped).max(channel.damaged);
            if lost > 0 {
                *recovery.lost_messages.entry(channel.topic.clone()).or_default() += lost;
            }
            (channel.behind_loss, channel.damaged) = (false, 0);
        }
        channel.last_sequence = Some(header.sequence);
    }

    /// A message record whose body is damaged.
    pub fn note_damaged(&mut self, body: &[u8]) {
        if let Ok(Record::Message { header, .. }) = parse(op::MESSAGE, body)
            && let Some(channel) = self.channels.get_mut(&header.channel_id)
        {
            channel.damaged += 1;
        }
    }

    /// These bytes are no use, `zero_bytes` of them zeros.
    pub fn note_lost(&mut self, bytes: Range<u64>, zero_bytes: u64) {
        self.channels.values_mut().for_each(|channel| channel.behind_loss = true);
        self.recovery.lost_bytes += bytes.end - bytes.start;
        self.recovery.zero_bytes += zero_bytes;
        let spans = &mut self.recovery.spans;
        let is_full = spans.len() == Recovery::MAX_SPANS;
        match spans.last_mut() {
            Some(span) if span.before_ns.is_none() => span.bytes = bytes.end - span.offset,
            _ if is_full => {}
            _ => {
                let (offset, bytes) = (bytes.start, bytes.end - bytes.start);
                spans.push(LostSpan { offset, bytes, after_ns: self.last_log_ns, before_ns: None });
            }
        }
    }

    pub fn close(mut self, unreadable_bytes: u64) -> Recovery {
        for channel in self.channels.into_values() {
            if channel.damaged > 0 {
                *self.recovery.lost_messages.entry(channel.topic).or_default() += channel.damaged;
            }
        }
        self.recovery.unreadable_bytes = unreadable_bytes;
        self.recovery
    }
}
