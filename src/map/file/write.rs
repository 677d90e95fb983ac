//! A map's way into a file.

use std::collections::BTreeMap;

use faer::MatRef;
use safetensors::tensor::{Dtype, TensorView, serialize};

use super::{CHECKSUM, COMPASS_SIGNATURES, COMPASS_YAWS, FIELDS, METADATA_KEY, checksum, sums_of};
use crate::features::COMPASS_BYTES;
use crate::map::{Block, FeatureMap};

/// One tensor on its way into a file.
struct Tensor {
    dtype: Dtype,
    shape: Vec<usize>,
    bytes: Vec<u8>,
}

/// The file's bytes.
pub fn to_bytes(map: &FeatureMap) -> Vec<u8> {
    let mut tensors = Tensors::default();
    let n = map.positions_m.len();
    tensors.insert("positions_m", Tensor::of(Dtype::F64, &[n, 2], map.positions_m.iter().flatten(), f64::to_le_bytes));
    let cells = map.cells.indices();
    tensors.insert("cells", Tensor::of(Dtype::U32, &[cells.len(), 2], cells.iter().flatten(), u32::to_le_bytes));
    for (info, group) in map.info.groups.iter().zip(&map.groups) {
        let name = |part: &str| format!("{}/{part}", info.recipe.descriptor);
        let mean = &group.scaling.mean;
        tensors.insert(&name("mean"), Tensor::of(Dtype::F64, &[mean.len()], mean, f64::to_le_bytes));
        tensors.insert(&name("projection"), Tensor::of_matrix(group.scaling.projection.as_ref()));
        let learning = Tensor::of_matrix(group.learning.as_ref());
        let whole = learning.bytes.len();
        tensors.insert_in_parts(&name("learning"), learning, &[whole]);
    }
    let (fields, parts) = fields(map);
    tensors.insert_in_parts(FIELDS, fields, &parts);
    if let Some(compass) = &map.compass {
        tensors.insert(COMPASS_YAWS, Tensor::of(Dtype::F64, &[n], &compass.yaws_rad, f64::to_le_bytes));
        let signatures = Tensor::of(Dtype::I8, &[n, COMPASS_BYTES], &compass.signatures, i8::to_le_bytes);
        tensors.insert_in_parts(COMPASS_SIGNATURES, signatures, &vec![COMPASS_BYTES; n]);
    }
    let info = serde_json::to_string(&map.info).expect("map information is plain data");
    tensors.into_bytes(info)
}

/// All blocks one behind the other, and how many bytes each has.
fn fields(map: &FeatureMap) -> (Tensor, Vec<usize>) {
    let c = map.cells.len();
    let (mut bytes, mut parts) = (Vec::new(), Vec::new());
    for block in Block::all_of(&map.cells) {
        let before = bytes.len();
        for group in &map.groups {
            for row in [&group.field_mean, &group.field_variance].into_iter().flat_map(|rows| rows.chunks_exact(c)) {
                bytes.extend(block.cells.iter().flat_map(|&cell| row[cell as usize].to_le_bytes()));
            }
        }
        parts.push(bytes.len() - before);
    }
    (Tensor { dtype: Dtype::F32, shape: vec![bytes.len() / size_of::<f32>()], bytes }, parts)
}

#[derive(Default)]
struct Tensors {
    /// Those that the one checksum covers.
    whole: BTreeMap<String, Tensor>,
    in_parts: BTreeMap<String, Tensor>,
}

impl Tensors {
    fn insert(&mut self, name: &str, tensor: Tensor) {
        self.whole.insert(name.into(), tensor);
    }

    /// A tensor whose parts, of so many bytes each, have sums of their own.
    fn insert_in_parts(&mut self, name: &str, tensor: Tensor, parts: &[usize]) {
        let mut rest = tensor.bytes.as_slice();
        let mut next = |part: usize| {
            let bytes;
            (bytes, rest) = rest.split_at(part);
            crc32fast::hash(bytes)
        };
        let sums: Vec<u32> = parts.iter().map(|&part| next(part)).collect();
        self.insert(&sums_of(name), Tensor::of(Dtype::U32, &[sums.len()], &sums, u32::to_le_bytes));
        self.in_parts.insert(name.into(), tensor);
    }

    fn into_bytes(mut self, info: String) -> Vec<u8> {
        let whole = self.whole.iter().map(|(name, tensor)| (name.as_str(), tensor.bytes.as_slice()));
        let checksum = checksum(&info, whole);
        self.insert(CHECKSUM, Tensor { dtype: Dtype::U8, shape: vec![checksum.len()], bytes: checksum });
        let views = self.whole.iter().chain(&self.in_parts).map(|(name, tensor)| (name, tensor.view()));
        let metadata = std::iter::once((METADATA_KEY.to_owned(), info)).collect();
        serialize(views, Some(metadata)).expect("shapes fit the data")
    }
}

impl Tensor {
    fn of<'a, T: Copy + 'a, const N: usize>(
        dtype: Dtype,
        shape: &[usize],
        values: impl IntoIterator<Item = &'a T>,
        bytes: impl Fn(T) -> [u8; N],
    ) -> Self {
        Self { dtype, shape: shape.to_vec(), bytes: values.into_iter().flat_map(|&value| bytes(value)).collect() }
    }

    /// Row-major.
    fn of_matrix(matrix: MatRef<f64>) -> Self {
        let rows = (0..matrix.nrows()).flat_map(|i| matrix.row(i).iter());
        Self::of(Dtype::F64, &[matrix.nrows(), matrix.ncols()], rows, f64::to_le_bytes)
    }

    fn view(&self) -> TensorView<'_> {
        TensorView::new(self.dtype, self.shape.clone(), &self.bytes).expect("the shape fits the data")
    }
}
