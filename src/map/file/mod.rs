//! The map file: safetensors, so that it can be read from Python without our code, and in parts.
//!
//! The metadata key `omniloc` holds [`MapInfo`](super::MapInfo) as JSON. Tensors:
//!
//! | name | type, shape | content |
//! |---|---|---|
//! | `positions_m` | f64 \[n, 2\] | learning positions, east and north |
//! | `cells` | u32 \[c, 2\] | column and row of every candidate cell in the grid |
//! | `G/mean` | f64 \[d\] | μ of group G's scaling z = W (y − μ); G is the descriptor's name |
//! | `G/projection` | f64 \[k, d\] | W |
//! | `G/learning` | f64 \[n, k\] | learning features |
//! | `fields` | f32 \[…\] | every feature on the cells, block by block: see below |
//! | `compass/yaw_rad` | f64 \[n\] | headings of the learning panoramas; absent where they are not known |
//! | `compass/signatures` | i8 \[n, s\] | signatures of the learning panoramas, with `compass/yaw_rad` |
//! | `T/crc32` | u32 \[p\] | CRC-32 of every part of tensor T: of the blocks of `fields`, the rows of `compass/signatures`, and of a `G/learning` as a whole |
//! | `sha256` | u8 \[32\] | of the metadata string and then, in the order of their names, name and data of all tensors that have no `T/crc32` |
//!
//! A *block* holds the candidates within a square of [`BLOCK_SIDE`](super::BLOCK_SIDE) × as many cells of the grid, the
//! first of which begins at column and row 0. Blocks without candidates are left out; the others follow each other by row,
//! then column, and so do the cells within one. Of a block with b cells, `fields` has for every group, in the order of the
//! metadata, the posterior mean of every feature (k × b), and then the predictive variance, noise included: k × b, or 1 × b
//! where the features share their hyperparameters.

mod open;
mod tensors;
mod write;

use std::fs::File;

pub use open::{GroupField, OpenMap};
pub use tensors::ReadAt;
pub use write::to_bytes;

use super::FeatureMap;

/// What this build writes, and the only one it reads.
pub const FORMAT_VERSION: u32 = 5;
const METADATA_KEY: &str = "omniloc";
const CHECKSUM: &str = "sha256";
const FIELDS: &str = "fields";
const COMPASS_YAWS: &str = "compass/yaw_rad";
const COMPASS_SIGNATURES: &str = "compass/signatures";

#[derive(Debug, thiserror::Error)]
pub enum MapError {
    #[error("not a map: {0}")]
    NotAMap(String),
    #[error(
        "map file is version {found}, this build reads version {FORMAT_VERSION}: {}",
        if *found > u64::from(FORMAT_VERSION) { "install a newer omniloc" } else { "train the map again" }
    )]
    UnsupportedVersion { found: u64 },
    #[error("the map is damaged: its checksum does not fit its content; copy or train it again")]
    Checksum,
    #[error("the map is damaged: {0}; copy or train it again")]
    Damaged(String),
    #[error("cannot read")]
    Io(#[from] std::io::Error),
}

/// Reads a map with everything in it.
///
/// # Errors
/// Says whether the file is no map, of another version, or damaged, and where.
pub fn read(file: File) -> Result<FeatureMap, MapError> {
    OpenMap::open(Box::new(file))?.into_map()
}

/// The map of a file's bytes.
///
/// # Errors
/// As [`read`].
pub fn from_bytes(bytes: &[u8]) -> Result<FeatureMap, MapError> {
    OpenMap::open(Box::new(bytes.to_vec()))?.into_map()
}

/// The sum over what has no sums of its own.
fn checksum<'a>(info: &str, tensors: impl Iterator<Item = (&'a str, &'a [u8])>) -> Vec<u8> {
    use sha2::{Digest, Sha256};

    let mut hash = Sha256::new();
    hash.update(info.as_bytes());
    for (name, bytes) in tensors {
        hash.update(name.as_bytes());
        hash.update(bytes);
    }
    hash.finalize().to_vec()
}

/// Where the sums of a tensor's parts are.
fn sums_of(name: &str) -> String {
    format!("{name}/crc32")
}

#[cfg(test)]
mod tests {
    use proptest::prelude::*;

    use super::*;
    use crate::gp::Hyperparameters;
    use crate::map::tests::small_map;
    use crate::map::{CandidateCells, GroupHyperparameters};

    #[test]
    fn a_map_survives_saving_and_loading() {
        let map = small_map();
        let bytes = to_bytes(&map);
        assert_eq!(bytes, to_bytes(&map), "the same map, the same bytes");
        let loaded = from_bytes(&bytes).expect("sound");
        assert_eq!(loaded.info, map.info);
        assert_eq!((loaded.positions_m, loaded.cells), (map.positions_m, map.cells));
        assert_eq!(loaded.compass, map.compass);
        for (loaded, group) in loaded.groups.iter().zip(&map.groups) {
            assert_eq!(loaded.scaling.mean, group.scaling.mean);
            assert_eq!(loaded.scaling.projection, group.scaling.projection);
            assert_eq!(loaded.learning, group.learning);
            assert_eq!((&loaded.field_mean, &loaded.field_variance), (&group.field_mean, &group.field_variance));
        }
    }

    /// A road of a hundred metres, in seven blocks.
    fn long_map() -> FeatureMap {
        let road: Vec<_> = (0..100).map(|i| [f64::from(i), 20.0]).collect();
        let cells = CandidateCells::around(&road, 1.0, Some(3.0)).expect("a small grid");
        let mut map = small_map();
        map.groups[0].field_mean = (0..2 * cells.len()).map(|i| i as f32).collect();
        map.groups[0].field_variance = (0..cells.len()).map(|i| 1.0 + i as f32).collect();
        (map.info.grid, map.cells) = (cells.grid, cells);
        map
    }

    #[test]
    fn a_block_is_read_by_itself() {
        let map = long_map();
        let open = OpenMap::open(Box::new(to_bytes(&map))).expect("sound");
        assert_eq!(open.blocks.len(), 7);
        let c = map.cells.len();
        assert_eq!(open.fields_bytes(), 3 * c * size_of::<f32>());
        for (number, block) in open.blocks.iter().enumerate() {
            let field = &open.fields_of_block(number).expect("sound")[0];
            let of_block = |row: &[f32]| block.cells.iter().map(|&cell| row[cell as usize]).collect::<Vec<_>>();
            let group = &map.groups[0];
            assert_eq!(field.mean, group.field_mean.chunks(c).flat_map(of_block).collect::<Vec<_>>());
            assert_eq!(field.variance, of_block(&group.field_variance));
        }
        let all = &open.all_fields().expect("sound")[0];
        assert_eq!((&all.mean, &all.variance), (&map.groups[0].field_mean, &map.groups[0].field_variance));
        let near = open.compass(|position_m| position_m[0] > 0.5).expect("sound").expect("has one");
        assert_eq!((near.positions_m.as_slice(), near.yaws_rad.as_slice()), (&map.positions_m[1..], &[0.2, -3.0][..]));
        assert_eq!(near.signature(1), map.compass.as_ref().expect("has one").signature(2));
    }

    /// The other parts can still be used.
    #[test]
    fn a_damaged_block_is_noticed_when_it_is_read() {
        let map = long_map();
        let mut bytes = to_bytes(&map);
        let third = map.groups[0].field_mean[33].to_le_bytes();
        let at = bytes.windows(4).rposition(|window| window == third).expect("the value is there");
        bytes[at] ^= 1;
        let open = OpenMap::open(Box::new(bytes)).expect("the whole is sound");
        let outcomes: Vec<bool> = (0..open.blocks.len()).map(|block| open.fields_of_block(block).is_ok()).collect();
        assert_eq!(outcomes.iter().filter(|is_sound| !**is_sound).count(), 1, "{outcomes:?}");
        let error = open.into_map().map(|_| ()).expect_err("damaged");
        assert!(error.to_string().contains("of fields does not fit its checksum"), "{error}");
    }

    #[test]
    fn a_map_of_a_newer_version_is_refused() {
        let mut map = small_map();
        map.info.format_version = 7;
        let error = from_bytes(&to_bytes(&map)).expect_err("newer");
        assert_eq!(error.to_string(), "map file is version 7, this build reads version 5: install a newer omniloc");
    }

    #[test]
    fn a_map_cut_anywhere_is_refused() {
        let bytes = to_bytes(&small_map());
        for length in 0..bytes.len() {
            assert!(from_bytes(&bytes[..length]).is_err(), "{length} of {} bytes were accepted", bytes.len());
        }
        let error = from_bytes(&bytes[..bytes.len() - 5]).expect_err("cut").to_string();
        assert!(error.contains("damaged"), "{error}");
    }

    /// Maps whose checksum fits but that no training writes.
    #[test]
    fn an_impossible_map_is_refused() {
        type Spoil = fn(&mut FeatureMap);
        let table: [(&str, Spoil); 12] = [
            ("no gaps", |map| map.info.gap_ratio = 0.0),
            ("no groups", |map| {
                map.info.groups.clear();
                map.groups.clear();
            }),
            ("no features", |map| map.info.groups[0].features = 0),
            ("more features than rank", |map| map.info.groups[0].rank = 1),
            ("the same group twice", |map| {
                map.info.groups.push(map.info.groups[0].clone());
                map.groups.push(map.groups[0].clone());
            }),
            ("a huge donut", |map| map.info.calibration.outer_radius_px = 1e9),
            ("a huge image", |map| map.info.image_size_px = [1 << 40, 1 << 40]),
            ("a tiny step", |map| map.info.grid.step_m = 1e-300),
            ("a huge grid", |map| map.info.grid.columns = u32::MAX),
            ("a far grid", |map| map.info.grid.origin_m = [1e300, 0.0]),
            ("no recordings", |map| map.info.recordings.clear()),
            ("negative noise", |map| {
                let bad = Hyperparameters { signal_std: 1.0, noise_std: -1.0, length_scale_m: [1.0; 2] };
                map.info.groups[0].hyperparameters = GroupHyperparameters::Shared(bad);
            }),
        ];
        for (case, spoil) in table {
            let mut map = small_map();
            spoil(&mut map);
            let error = from_bytes(&to_bytes(&map)).expect_err(case);
            assert!(matches!(error, MapError::Damaged(_)), "{case}: {error}");
        }
    }

    #[test]
    fn something_else_is_no_map() {
        for bytes in [&b""[..], b"hello", &[0xFF; 300], b"\x02\0\0\0\0\0\0\0{}"] {
            assert!(matches!(from_bytes(bytes), Err(MapError::NotAMap(_))), "{bytes:?}");
        }
    }

    proptest! {
        #[test]
        fn a_flipped_bit_is_noticed(at in any::<prop::sample::Index>(), bit in 0_u32..8) {
            let mut bytes = to_bytes(&small_map());
            let at = at.index(bytes.len());
            bytes[at] ^= 1_u8 << bit;
            // White space in the header's padding is all that may differ.
            if let Ok(map) = from_bytes(&bytes) {
                prop_assert_eq!(to_bytes(&map), to_bytes(&small_map()));
            }
        }
    }
}
