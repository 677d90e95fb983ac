//! Bytes → NMEA sentences and Xbus packets.
//!
//! ```text
//! $ talker+name , fields * hh CR LF         hh = XOR of what is between $ and *, at most 256 bytes with $ and LF
//! FA FF mid len data sum                    sum makes the bytes after FA add up to 0 (mod 256)
//! FA FF mid FF len-high len-low data sum    the same with more than 254 bytes of data, at most 2048
//! ```
//!
//! The two may come mixed on one line. Bytes are taken one at a time, so how they were cut into chunks makes no
//! difference. What starts a packet may be chance: a packet with a wrong sum gives up its first byte only and the search
//! goes on at the next one, and a whole sentence with a right sum inside an unfinished packet wins over the packet. So
//! garbage never hides what follows it for longer than a packet, and never a sentence.

/// With `$` and LF. NMEA 0183 allows 82, but real sentences go up to 114 (Xsens PSONCMS).
pub const MAX_SENTENCE_BYTES: usize = 256;

/// Longest data of an Xbus packet with extended length.
pub const MAX_PACKET_DATA_BYTES: usize = 2048;

const PREAMBLE: u8 = 0xFA;
/// The bus identifier of a sensor that is connected directly.
const BUS_ID: u8 = 0xFF;
const EXTENDED_LENGTH: u8 = 0xFF;
const HEADER_BYTES: usize = 4;
const EXTENDED_HEADER_BYTES: usize = 6;
const CR: u8 = b'\r';
const LF: u8 = b'\n';

/// What to look for.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Default, serde::Deserialize, serde::Serialize)]
#[serde(rename_all = "lowercase")]
pub enum Protocol {
    Nmea,
    Xbus,
    /// Both, also mixed.
    #[default]
    Auto,
}

/// One thing whole and with a right sum.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum Framed<'a> {
    /// What stands between `$` and `*`: printable ASCII.
    Sentence(&'a str),
    Packet {
        message_id: u8,
        data: &'a [u8],
    },
}

/// What became of the bytes. Each is in `framed_bytes`, in `skipped_bytes`, or still pending.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Default)]
pub struct FramingCounters {
    pub bytes: u64,
    /// Bytes of whole sentences and packets.
    pub framed_bytes: u64,
    /// Bytes of nothing: noise, line ends of nothing, and all that was refused.
    pub skipped_bytes: u64,
    pub sentences: u64,
    pub packets: u64,
    /// Sentences whose sum is wrong.
    pub wrong_sentence_sums: u64,
    /// Sentences that end without `*hh`.
    pub missing_sums: u64,
    /// Sentences longer than [`MAX_SENTENCE_BYTES`].
    pub overlong_sentences: u64,
    /// Sentences cut off by another `$` or by a byte that is not printable ASCII.
    pub broken_sentences: u64,
    /// Starts of packets whose sum is wrong; many of them are chance.
    pub wrong_packet_sums: u64,
    /// Starts of packets longer than [`MAX_PACKET_DATA_BYTES`], or cut off by a sentence.
    pub broken_packets: u64,
}

impl FramingCounters {
    /// Sentences and packets that were refused.
    pub fn refused(&self) -> u64 {
        self.wrong_sentence_sums
            + self.missing_sums
            + self.overlong_sentences
            + self.broken_sentences
            + self.wrong_packet_sums
            + self.broken_packets
    }
}

/// Takes a stream of bytes apart.
#[derive(Debug, Clone)]
pub struct Framer {
    protocol: Protocol,
    counters: FramingCounters,
    /// The last bytes of the stream, not yet told to be framed or skipped: begins with the start of a packet or of a
    /// sentence, or is empty.
    pending: Vec<u8>,
    /// Where in `pending` the sentence under way begins.
    sentence_start: Option<usize>,
}

impl Framer {
    pub fn new(protocol: Protocol) -> Self {
        let pending = Vec::with_capacity(MAX_PACKET_DATA_BYTES + EXTENDED_HEADER_BYTES + 1);
        Self { protocol, counters: FramingCounters::default(), pending, sentence_start: None }
    }

    pub fn counters(&self) -> &FramingCounters {
        &self.counters
    }

    /// Bytes that may still become something.
    pub fn pending_bytes(&self) -> usize {
        self.pending.len()
    }

    /// Takes one byte. `emit` gets what is complete with it, in the order of the stream, each with the count of bytes
    /// that came after its last one (0 except after a false start of a packet).
    pub fn push(&mut self, byte: u8, emit: &mut dyn FnMut(Framed<'_>, usize)) {
        self.counters.bytes += 1;
        self.pending.push(byte);
        if self.protocol != Protocol::Xbus {
            self.follow_sentence(byte, emit);
        }
        self.search(emit);
    }

    /// Follows the sentence under way, also inside of what may be a packet.
    fn follow_sentence(&mut self, byte: u8, emit: &mut dyn FnMut(Framed<'_>, usize)) {
        let end = self.pending.len();
        if byte == b'$' {
            if self.sentence_start == Some(0) {
                self.counters.broken_sentences += 1;
            }
            self.sentence_start = Some(end - 1);
            return;
        }
        let Some(start) = self.sentence_start else { return };
        let body = &self.pending[start + 1..end];
        let after_cr = body.len() >= 2 && body[body.len() - 2] == CR;
        let refused = match byte {
            LF => match sentence_content(body) {
                Ok(content) => {
                    emit(Framed::Sentence(content), 0);
                    self.counters.sentences += 1;
                    self.counters.framed_bytes += (end - start) as u64;
                    self.counters.skipped_bytes += start as u64;
                    // What looked like a packet before or around it was none.
                    self.counters.broken_packets += u64::from(start > 0);
                    self.pending.clear();
                    self.sentence_start = None;
                    return;
                }
                Err(BadSum::Missing) => &mut self.counters.missing_sums,
                Err(BadSum::Wrong) => &mut self.counters.wrong_sentence_sums,
            },
            CR | b' '..=b'~' if !after_cr && end - start < MAX_SENTENCE_BYTES => return,
            CR | b' '..=b'~' if !after_cr => &mut self.counters.overlong_sentences,
            _ => &mut self.counters.broken_sentences,
        };
        // A `$` among the data of a packet is no sentence.
        *refused += u64::from(start == 0);
        self.sentence_start = None;
    }

    /// Skips bytes, and emits packets, until what is pending starts with something that more bytes can complete.
    fn search(&mut self, emit: &mut dyn FnMut(Framed<'_>, usize)) {
        let mut from = 0;
        while from < self.pending.len() && self.sentence_start != Some(from) {
            let candidate =
                if self.protocol == Protocol::Nmea { Candidate::No } else { packet_at(&self.pending[from..]) };
            match candidate {
                Candidate::Incomplete => break,
                Candidate::Whole { header_bytes, bytes } => {
                    let end = from + bytes;
                    let data = &self.pending[from + header_bytes..end - 1];
                    emit(Framed::Packet { message_id: self.pending[from + 2], data }, self.pending.len() - end);
                    self.counters.packets += 1;
                    self.counters.framed_bytes += bytes as u64;
                    from = end;
                    // A `$` among its data is no sentence.
                    self.sentence_start = self.sentence_start.filter(|&start| start >= end);
                    continue;
                }
                Candidate::WrongSum => self.counters.wrong_packet_sums += 1,
                Candidate::TooLong => self.counters.broken_packets += 1,
                Candidate::No => {}
            }
            from += 1;
            self.counters.skipped_bytes += 1;
        }
        self.pending.drain(..from);
        self.sentence_start = self.sentence_start.map(|start| start - from);
    }
}

enum BadSum {
    Missing,
    Wrong,
}

/// `body`: what comes after `$`, with the line end. Returns what stands before `*hh` if that is its XOR.
fn sentence_content(body: &[u8]) -> Result<&str, BadSum> {
    let line = body.strip_suffix(b"\n").unwrap_or(body);
    let line = line.strip_suffix(b"\r").unwrap_or(line);
    let [content @ .., b'*', high, low] = line else { return Err(BadSum::Missing) };
    let (Some(high), Some(low)) = (hex_digit(*high), hex_digit(*low)) else { return Err(BadSum::Missing) };
    if xor(content) != high << 4 | low {
        return Err(BadSum::Wrong);
    }
    // Every byte was seen to be printable ASCII.
    str::from_utf8(content).map_err(|_| BadSum::Wrong)
}

fn hex_digit(digit: u8) -> Option<u8> {
    char::from(digit).to_digit(16).map(|value| value as u8)
}

/// The sum of a sentence: XOR of what stands between `$` and `*`.
pub(crate) fn xor(content: &[u8]) -> u8 {
    content.iter().fold(0, |sum, byte| sum ^ byte)
}

/// The last byte of a packet: makes the bytes after the preamble add up to 0.
pub(super) fn packet_sum(after_preamble: &[u8]) -> u8 {
    after_preamble.iter().fold(0_u8, |sum, &byte| sum.wrapping_sub(byte))
}

enum Candidate {
    /// No packet starts here.
    No,
    Incomplete,
    WrongSum,
    TooLong,
    /// `bytes`: of all of it, with preamble and sum.
    Whole {
        header_bytes: usize,
        bytes: usize,
    },
}

fn packet_at(bytes: &[u8]) -> Candidate {
    let (header_bytes, data_bytes) = match *bytes {
        [PREAMBLE, BUS_ID, _, EXTENDED_LENGTH, high, low, ..] => {
            (EXTENDED_HEADER_BYTES, usize::from(u16::from_be_bytes([high, low])))
        }
        [PREAMBLE, BUS_ID, _, length, ..] if length != EXTENDED_LENGTH => (HEADER_BYTES, usize::from(length)),
        [PREAMBLE, BUS_ID, ..] | [PREAMBLE] => return Candidate::Incomplete,
        _ => return Candidate::No,
    };
    let whole_bytes = header_bytes + data_bytes + 1;
    if data_bytes > MAX_PACKET_DATA_BYTES {
        Candidate::TooLong
    } else if bytes.len() < whole_bytes {
        Candidate::Incomplete
    } else if packet_sum(&bytes[1..whole_bytes]) != 0 {
        Candidate::WrongSum
    } else {
        Candidate::Whole { header_bytes, bytes: whole_bytes }
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    fn framed(protocol: Protocol, bytes: &[u8]) -> (Vec<String>, FramingCounters) {
        let mut framer = Framer::new(protocol);
        let mut found = Vec::new();
        for &byte in bytes {
            framer.push(byte, &mut |framed, _| {
                found.push(match framed {
                    Framed::Sentence(content) => content.to_owned(),
                    Framed::Packet { message_id, data } => format!("{message_id:02x} {data:02x?}"),
                });
            });
            let counters = framer.counters();
            let told = counters.framed_bytes + counters.skipped_bytes + framer.pending_bytes() as u64;
            assert_eq!(told, counters.bytes, "every byte is framed, skipped or pending");
        }
        (found, *framer.counters())
    }

    /// The example of the LLCP: GoToConfig's acknowledgement.
    const ACK: [u8; 5] = [0xFA, 0xFF, 0x31, 0x00, 0xD0];

    #[test]
    fn sentences_need_a_right_sum_and_a_line_end() {
        for (bytes, expected) in [
            (&b"$HEHDT,341.8,T*21\r\n"[..], 1),
            (b"$HEHDT,341.8,T*21\n", 1),
            (b"noise$HEHDT,341.8,T*21\r\n", 1),
            (b"$HEHDT,341.8$HEHDT,341.8,T*21\r\n", 1),
            (b"$HEHDT,341.8,T*22\r\n", 0),
            (b"$HEHDT,341.8,T*2\r\n", 0),
            (b"$HEHDT,341.8,T\r\n", 0),
            (b"$HEHDT,341.8,T*21", 0),
            (b"$HEHDT,341.8,T*21\r$", 0),
            (b"$HEHDT,341.8,\xffT*21\r\n", 0),
        ] {
            let (found, counters) = framed(Protocol::Auto, bytes);
            assert_eq!(found.len(), expected, "{}", String::from_utf8_lossy(bytes));
            assert_eq!(counters.sentences, expected as u64);
        }
    }

    #[test]
    fn reasons_of_refusal_are_counted_apart() {
        let overlong = [&b"$"[..], &[b'x'; 300], b"\r\n"].concat();
        for (bytes, field) in [
            (&b"$HEHDT,341.8,T*22\r\n"[..], (|c| c.wrong_sentence_sums) as fn(&FramingCounters) -> u64),
            (b"$HEHDT,341.8,T\r\n", |c| c.missing_sums),
            (&overlong, |c| c.overlong_sentences),
            (b"$HEHDT,\x07", |c| c.broken_sentences),
            (b"$HEHDT,$", |c| c.broken_sentences),
            (&[0xFA, 0xFF, 0x31, 0x00, 0xD1], |c| c.wrong_packet_sums),
            (&[0xFA, 0xFF, 0x31, 0xFF, 0xD1, 0x00], |c| c.broken_packets),
        ] {
            let (found, counters) = framed(Protocol::Auto, bytes);
            assert_eq!((found.len(), field(&counters), counters.refused()), (0, 1, 1), "{bytes:02x?} {counters:?}");
        }
    }

    #[test]
    fn a_sentence_ends_an_unfinished_packet() {
        let bytes = [&[0xFA, 0xFF, 0x36, 0xF0][..], b"$HEHDT,341.8,T*21\r\n", &ACK].concat();
        let (found, _) = framed(Protocol::Auto, &bytes);
        assert_eq!(found, ["HEHDT,341.8,T", "31 []"]);
    }

    #[test]
    fn packets_swallowed_by_a_false_start_come_out_in_order() {
        let bytes = [&[0xFA, 0xFF, 0x36, 0x0C][..], &ACK, &ACK, &ACK, &ACK].concat();
        let (found, counters) = framed(Protocol::Xbus, &bytes);
        assert_eq!(found.len(), 4);
        assert_eq!(counters.wrong_packet_sums, 1);
    }

    #[test]
    fn a_packet_may_hold_what_looks_like_a_start() {
        let mut packet = vec![0xFA, 0xFF, 0x36, 0x06, b'$', 0xFA, 0xFF, 0x36, b'$', b'G'];
        packet.push(packet_sum(&packet[1..]));
        let (found, counters) = framed(Protocol::Auto, &[&packet[..], &ACK].concat());
        assert_eq!(found.len(), 2);
        assert_eq!(counters.refused(), 0);
    }

    #[test]
    fn extended_length_reaches_2048_bytes() {
        let mut packet = vec![0xFA, 0xFF, 0x36, 0xFF, 0x08, 0x00];
        packet.extend([0x55; 2048]);
        packet.push(packet_sum(&packet[1..]));
        assert_eq!(framed(Protocol::Auto, &packet).1.packets, 1);
    }

    #[test]
    fn a_chosen_protocol_leaves_the_other_alone() {
        let bytes = [&ACK[..], b"$HEHDT,341.8,T*21\r\n"].concat();
        assert_eq!(framed(Protocol::Nmea, &bytes).0, ["HEHDT,341.8,T"]);
        assert_eq!(framed(Protocol::Xbus, &bytes).0, ["31 []"]);
    }
}
