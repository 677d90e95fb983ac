//! The map file: safetensors, so that it can be mapped into memory and read from Python without our code.
//!
//! The metadata key `omniloc` holds [`MapInfo`] as JSON. Tensors:
//!
//! | name | type, shape | content |
//! |---|---|---|
//! | `positions_m` | f64 \[n, 2\] | learning positions, east and north |
//! | `cells` | u32 \[c, 2\] | column and row of every candidate cell in the grid |
//! | `G/mean` | f64 \[d\] | μ of group G's scaling z = W (y − μ); G is the descriptor's name |
//! | `G/projection` | f64 \[k, d\] | W |
//! | `G/learning` | f64 \[n, k\] | learning features |
//! | `G/field_mean` | f32 \[k, c\] | posterior mean of every feature on the cells |
//! | `G/field_variance` | f32 \[k, c\] or \[1, c\] | predictive variance, noise included; one row where all share it |
//! | `compass/yaw_rad` | f64 \[n\] | headings of the learning panoramas; absent where they are not known |
//! | `compass/signatures` | i8 \[n, s\] | signatures of the learning panoramas, with `compass/yaw_rad` |
//! | `sha256` | u8 \[32\] | of the metadata string and then, in the order of their names, name and data of all others |

use std::collections::BTreeMap;
use std::io::Read;

use faer::{Mat, MatRef};
use safetensors::tensor::{Dtype, Metadata, SafeTensors, TensorView, serialize};
use sha2::{Digest, Sha256};

use super::{CandidateCells, Compass, FeatureMap, MapGroup, MapInfo};
use crate::features::COMPASS_BYTES;
use crate::features::scaling::Scaling;
use crate::types::PositionM;

/// What this build writes, and the only one it reads.
pub const FORMAT_VERSION: u32 = 2;
const METADATA_KEY: &str = "omniloc";
const CHECKSUM: &str = "sha256";
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

/// One tensor on its way into a file.
struct Tensor {
    dtype: Dtype,
    shape: Vec<usize>,
    bytes: Vec<u8>,
}

/// The file's bytes.
pub fn to_bytes(map: &FeatureMap) -> Vec<u8> {
    let mut tensors = BTreeMap::new();
    let positions = map.positions_m.iter().flatten().flat_map(|value| value.to_le_bytes()).collect();
    let cells = map.cells.indices().iter().flatten().flat_map(|value| value.to_le_bytes()).collect();
    tensors.insert("positions_m".to_owned(), Tensor::new(Dtype::F64, &[map.positions_m.len(), 2], positions));
    tensors.insert("cells".to_owned(), Tensor::new(Dtype::U32, &[map.cells.len(), 2], cells));
    for (info, group) in map.info.groups.iter().zip(&map.groups) {
        let mut insert = |part: &str, tensor| tensors.insert(format!("{}/{part}", info.recipe.descriptor), tensor);
        let k = group.scaling.features();
        let mean: Vec<u8> = group.scaling.mean.iter().flat_map(|value| value.to_le_bytes()).collect();
        insert("mean", Tensor::new(Dtype::F64, &[group.scaling.properties()], mean));
        insert("projection", Tensor::of_matrix(group.scaling.projection.as_ref()));
        insert("learning", Tensor::of_matrix(group.learning.as_ref()));
        let floats = |values: &[f32]| values.iter().flat_map(|value| value.to_le_bytes()).collect::<Vec<u8>>();
        let cells = map.cells.len();
        insert("field_mean", Tensor::new(Dtype::F32, &[k, cells], floats(&group.field_mean)));
        let rows = group.field_variance.len() / cells.max(1);
        insert("field_variance", Tensor::new(Dtype::F32, &[rows, cells], floats(&group.field_variance)));
    }
    if let Some(compass) = &map.compass {
        let yaws = compass.yaws_rad.iter().flat_map(|value| value.to_le_bytes()).collect();
        tensors.insert(COMPASS_YAWS.to_owned(), Tensor::new(Dtype::F64, &[compass.yaws_rad.len()], yaws));
        let signatures = compass.signatures.iter().flat_map(|value| value.to_le_bytes()).collect();
        let shape = [compass.yaws_rad.len(), COMPASS_BYTES];
        tensors.insert(COMPASS_SIGNATURES.to_owned(), Tensor::new(Dtype::I8, &shape, signatures));
    }
    let info = serde_json::to_string(&map.info).expect("map information is plain data");
    let checksum = checksum(&info, tensors.iter().map(|(name, tensor)| (name.as_str(), tensor.bytes.as_slice())));
    tensors.insert(CHECKSUM.to_owned(), Tensor::new(Dtype::U8, &[checksum.len()], checksum));
    let views = tensors.iter().map(|(name, tensor)| (name, tensor.view()));
    let metadata = std::iter::once((METADATA_KEY.to_owned(), info)).collect();
    serialize(views, Some(metadata)).expect("shapes fit the data")
}

impl Tensor {
    fn new(dtype: Dtype, shape: &[usize], bytes: Vec<u8>) -> Self {
        Self { dtype, shape: shape.to_vec(), bytes }
    }

    /// Row-major.
    fn of_matrix(matrix: MatRef<f64>) -> Self {
        let rows = (0..matrix.nrows()).flat_map(|i| matrix.row(i).iter().map(|value| value.to_le_bytes()));
        let bytes = rows.flatten().collect();
        Self::new(Dtype::F64, &[matrix.nrows(), matrix.ncols()], bytes)
    }

    fn view(&self) -> TensorView<'_> {
        TensorView::new(self.dtype, self.shape.clone(), &self.bytes).expect("the shape fits the data")
    }
}

fn checksum<'a>(info: &str, tensors: impl Iterator<Item = (&'a str, &'a [u8])>) -> Vec<u8> {
    let mut hash = Sha256::new();
    hash.update(info.as_bytes());
    for (name, bytes) in tensors {
        hash.update(name.as_bytes());
        hash.update(bytes);
    }
    hash.finalize().to_vec()
}

/// Reads a map.
///
/// # Errors
/// Says whether the data is no map, of another version, or damaged, and where.
pub fn read(mut reader: impl Read) -> Result<FeatureMap, MapError> {
    let mut bytes = Vec::new();
    reader.read_to_end(&mut bytes)?;
    from_bytes(&bytes)
}

pub fn from_bytes(bytes: &[u8]) -> Result<FeatureMap, MapError> {
    let not_a_map = |error: &dyn std::fmt::Display| MapError::NotAMap(error.to_string());
    let metadata = header(bytes)?;
    let text = metadata.metadata().as_ref().and_then(|entries| entries.get(METADATA_KEY));
    let text = text.ok_or_else(|| not_a_map(&"a safetensors file, but not of omniloc"))?;
    // The version first: the rest of another version's information may look different.
    let json: serde_json::Value = serde_json::from_str(text).map_err(|error| not_a_map(&error))?;
    match json["format_version"].as_u64() {
        Some(found) if found != u64::from(FORMAT_VERSION) => return Err(MapError::UnsupportedVersion { found }),
        Some(_) => {}
        None => return Err(not_a_map(&"its format_version is not a whole number")),
    }
    let file = SafeTensors::deserialize(bytes).map_err(|error| MapError::Damaged(error.to_string()))?;
    let mut tensors: BTreeMap<String, TensorView> = file.tensors().into_iter().collect();
    let stated = tensors.remove(CHECKSUM).ok_or_else(|| MapError::Damaged("it has no checksum".into()))?;
    let found = checksum(text, tensors.iter().map(|(name, tensor)| (name.as_str(), tensor.data())));
    // A fuzzer would never get past it.
    if !cfg!(fuzzing) && stated.data() != found {
        return Err(MapError::Checksum);
    }
    let info: MapInfo = serde_json::from_value(json).map_err(|error| MapError::Damaged(error.to_string()))?;
    info.check().map_err(MapError::Damaged)?;
    Parts { tensors }.into_map(info)
}

/// The header of a safetensors file, without its tensors. Tells a file that was cut off from one that is something else.
fn header(bytes: &[u8]) -> Result<Metadata, MapError> {
    match SafeTensors::read_metadata(bytes) {
        Ok((_, metadata)) => Ok(metadata),
        Err(error) => {
            // Eight bytes of header length, then JSON: what a cut map still begins with.
            let cut = bytes.len() > 9
                && bytes[8] == b'{'
                && bytes.windows(METADATA_KEY.len() + 2).take(256).any(|w| w == b"\"omniloc\"");
            Err(if cut { MapError::Damaged(error.to_string()) } else { MapError::NotAMap(error.to_string()) })
        }
    }
}

/// The tensors of a file, to be taken out with their shapes checked.
struct Parts<'a> {
    tensors: BTreeMap<String, TensorView<'a>>,
}

impl Parts<'_> {
    fn into_map(self, info: MapInfo) -> Result<FeatureMap, MapError> {
        let damaged = |problem: String| MapError::Damaged(problem);
        let (positions, shape) = self.numbers("positions_m", Dtype::F64, f64::from_le_bytes)?;
        let n = self.rows("positions_m", &shape, 2)?;
        if n == 0 {
            return Err(damaged("it has no learning positions".into()));
        }
        let (cells, shape) = self.numbers("cells", Dtype::U32, u32::from_le_bytes)?;
        let c = self.rows("cells", &shape, 2)?;
        let cells = cells.chunks_exact(2).map(|pair| [pair[0], pair[1]]).collect();
        let cells = CandidateCells::from_parts(info.grid, cells).map_err(damaged)?;
        let mut groups = Vec::with_capacity(info.groups.len());
        for group in &info.groups {
            let (d, k) = (group.recipe.descriptor.dimensions(), group.features);
            let name = |part: &str| format!("{}/{part}", group.recipe.descriptor);
            let mean = self.exactly(&name("mean"), &[d], Dtype::F64, f64::from_le_bytes)?;
            let projection = self.exactly(&name("projection"), &[k, d], Dtype::F64, f64::from_le_bytes)?;
            let learning = self.exactly(&name("learning"), &[n, k], Dtype::F64, f64::from_le_bytes)?;
            let field_mean = self.exactly(&name("field_mean"), &[k, c], Dtype::F32, f32::from_le_bytes)?;
            let variance = name("field_variance");
            let (field_variance, shape) = self.numbers(&variance, Dtype::F32, f32::from_le_bytes)?;
            if shape != [k, c] && shape != [1, c] {
                return Err(damaged(format!("{variance} is {shape:?}, expected [{k}, {c}] or [1, {c}]")));
            }
            if let Some(bad) = field_variance.iter().find(|&&v| !(v.is_finite() && v > 0.0)) {
                return Err(damaged(format!("{variance} holds {bad}, expected positive numbers")));
            }
            groups.push(MapGroup {
                scaling: Scaling { mean, projection: Mat::from_fn(k, d, |r, i| projection[r * d + i]) },
                learning: Mat::from_fn(n, k, |i, r| learning[i * k + r]),
                field_mean,
                field_variance,
            });
        }
        let positions_m: Vec<PositionM> = positions.chunks_exact(2).map(|pair| [pair[0], pair[1]]).collect();
        let compass = self.compass(&info, &positions_m)?;
        Ok(FeatureMap { info, positions_m, cells, groups, compass })
    }

    fn compass(&self, info: &MapInfo, positions_m: &[PositionM]) -> Result<Option<Compass>, MapError> {
        let Some(std_rad) = info.heading_std_rad else { return Ok(None) };
        let n = positions_m.len();
        let yaws_rad = self.exactly(COMPASS_YAWS, &[n], Dtype::F64, f64::from_le_bytes)?;
        if let Some(bad) = yaws_rad.iter().find(|yaw_rad| yaw_rad.abs() > 100.0) {
            return Err(MapError::Damaged(format!("{COMPASS_YAWS} holds {bad}")));
        }
        let signatures = self.exactly(COMPASS_SIGNATURES, &[n, COMPASS_BYTES], Dtype::I8, i8::from_le_bytes)?;
        let sense = Compass::sense_of(info.calibration.azimuth);
        Ok(Some(Compass { positions_m: positions_m.to_vec(), yaws_rad, signatures, sense, std_rad }))
    }

    /// The numbers of a tensor, and its shape.
    fn numbers<T: Finite, const N: usize>(
        &self,
        name: &str,
        dtype: Dtype,
        parse: impl Fn([u8; N]) -> T,
    ) -> Result<(Vec<T>, Vec<usize>), MapError> {
        let tensor = self.tensors.get(name).ok_or_else(|| MapError::Damaged(format!("{name} is missing")))?;
        if tensor.dtype() != dtype {
            return Err(MapError::Damaged(format!("{name} is of {:?}, expected {dtype:?}", tensor.dtype())));
        }
        let numbers: Vec<T> = tensor.data().as_chunks::<N>().0.iter().map(|&bytes| parse(bytes)).collect();
        if numbers.iter().any(|number| !number.finite()) {
            return Err(MapError::Damaged(format!("{name} holds a value that is no finite number")));
        }
        Ok((numbers, tensor.shape().to_vec()))
    }

    fn exactly<T: Finite, const N: usize>(
        &self,
        name: &str,
        expected: &[usize],
        dtype: Dtype,
        parse: impl Fn([u8; N]) -> T,
    ) -> Result<Vec<T>, MapError> {
        let (numbers, shape) = self.numbers(name, dtype, parse)?;
        if shape != expected {
            return Err(MapError::Damaged(format!("{name} is {shape:?}, expected {expected:?}")));
        }
        Ok(numbers)
    }

    fn rows(&self, name: &str, shape: &[usize], columns: usize) -> Result<usize, MapError> {
        match *shape {
            [rows, found] if found == columns => Ok(rows),
            _ => Err(MapError::Damaged(format!("{name} is {shape:?}, expected [_, {columns}]"))),
        }
    }
}

/// Numbers that a map may hold.
trait Finite {
    fn finite(&self) -> bool;
}

impl Finite for f64 {
    fn finite(&self) -> bool {
        self.is_finite()
    }
}

impl Finite for f32 {
    fn finite(&self) -> bool {
        self.is_finite()
    }
}

impl Finite for i8 {
    fn finite(&self) -> bool {
        true
    }
}

impl Finite for u32 {
    fn finite(&self) -> bool {
        true
    }
}

#[cfg(test)]
mod tests {
    use proptest::prelude::*;

    use super::*;
    use crate::gp::Hyperparameters;
    use crate::map::GroupHyperparameters;
    use crate::map::tests::small_map;

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

    #[test]
    fn a_map_of_a_newer_version_is_refused() {
        let mut map = small_map();
        map.info.format_version = 7;
        let error = from_bytes(&to_bytes(&map)).expect_err("newer");
        assert_eq!(error.to_string(), "map file is version 7, this build reads version 2: install a newer omniloc");
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
            ("no weight", |map| map.info.groups[0].recipe.weight = 0.0),
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
