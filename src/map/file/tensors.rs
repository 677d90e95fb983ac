//! The tensors of a safetensors file, each read when it is asked for.

use std::collections::HashMap;
use std::fs::File;
use std::io;
use std::ops::Range;
use std::os::unix::fs::FileExt;

use safetensors::tensor::{Dtype, Metadata, TensorInfo};

use super::{METADATA_KEY, MapError};

/// Bytes that are read here and there: a file, or a file's content.
pub trait ReadAt: Send + Sync {
    fn length(&self) -> io::Result<u64>;

    /// Fills `bytes` with those from `offset` on.
    ///
    /// # Errors
    /// When there are not as many.
    fn read_exactly_at(&self, offset: u64, bytes: &mut [u8]) -> io::Result<()>;
}

impl ReadAt for File {
    fn length(&self) -> io::Result<u64> {
        Ok(self.metadata()?.len())
    }

    fn read_exactly_at(&self, offset: u64, bytes: &mut [u8]) -> io::Result<()> {
        self.read_exact_at(bytes, offset)
    }
}

impl ReadAt for Vec<u8> {
    fn length(&self) -> io::Result<u64> {
        Ok(self.len() as u64)
    }

    fn read_exactly_at(&self, offset: u64, bytes: &mut [u8]) -> io::Result<()> {
        let from = usize::try_from(offset).ok().filter(|&from| from <= self.len());
        let found = from.and_then(|from| self[from..].get(..bytes.len()));
        bytes.copy_from_slice(found.ok_or(io::ErrorKind::UnexpectedEof)?);
        Ok(())
    }
}

/// What a header says of its file's tensors.
pub struct TensorFile {
    reader: Box<dyn ReadAt>,
    /// Where the data begin.
    data: u64,
    tensors: HashMap<String, TensorInfo>,
    /// The metadata entry of this program.
    pub info: String,
}

/// Eight bytes of header length, then JSON.
const LENGTH_BYTES: usize = 8;
/// Longer headers than safetensors allows.
const MAX_HEADER_BYTES: u64 = 100_000_000;

impl TensorFile {
    /// Reads the header.
    pub fn open(reader: Box<dyn ReadAt>) -> Result<Self, MapError> {
        let length = reader.length()?;
        let mut start = [0; LENGTH_BYTES + 256];
        let sees = usize::try_from(length).unwrap_or(usize::MAX).min(start.len());
        reader.read_exactly_at(0, &mut start[..sees])?;
        let (header_length, begin) = start.split_first_chunk::<LENGTH_BYTES>().expect("long enough");
        let header_length = u64::from_le_bytes(*header_length);
        // A map that was cut off is told from something else by how it begins.
        let key = format!("\"{METADATA_KEY}\"").into_bytes();
        let is_cut = sees > LENGTH_BYTES && begin[0] == b'{' && begin.windows(key.len()).any(|window| window == key);
        let refuse = |what: String| if is_cut { MapError::Damaged(what) } else { MapError::NotAMap(what) };
        if sees <= LENGTH_BYTES || header_length > MAX_HEADER_BYTES.min(length - LENGTH_BYTES as u64) {
            return Err(refuse("its header is not complete".into()));
        }
        let mut header = vec![0; header_length as usize];
        reader.read_exactly_at(LENGTH_BYTES as u64, &mut header)?;
        let metadata: Metadata = serde_json::from_slice(&header).map_err(|error| refuse(error.to_string()))?;
        let info = metadata.metadata().as_ref().and_then(|entries| entries.get(METADATA_KEY)).cloned();
        let info = info.ok_or_else(|| refuse("a safetensors file, but not of omniloc".into()))?;
        let tensors: HashMap<_, _> = metadata.tensors().into_iter().map(|(name, info)| (name, info.clone())).collect();
        let data = LENGTH_BYTES as u64 + header_length;
        let file = Self { reader, data, tensors, info };
        file.check_ranges(length - data).map_err(MapError::Damaged)?;
        Ok(file)
    }

    /// Every tensor has the size of its shape, and the last of them ends where the file does.
    fn check_ranges(&self, length: u64) -> Result<(), String> {
        for (name, tensor) in &self.tensors {
            let numbers = tensor.shape.iter().try_fold(1_usize, |product, &side| product.checked_mul(side));
            let bytes = numbers.and_then(|numbers| numbers.checked_mul(bytes_of(tensor.dtype)?));
            let (from, to) = tensor.data_offsets;
            if bytes.is_none() || to.checked_sub(from) != bytes {
                return Err(format!("{name} is {:?} of {:?} in {from}..{to}", tensor.shape, tensor.dtype));
            }
        }
        let end = self.tensors.values().map(|tensor| tensor.data_offsets.1 as u64).max().unwrap_or(0);
        if end != length { Err(format!("it has {length} bytes of tensors, expected {end}")) } else { Ok(()) }
    }

    pub fn names(&self) -> Vec<String> {
        let mut names: Vec<String> = self.tensors.keys().cloned().collect();
        names.sort_unstable();
        names
    }

    pub fn has(&self, name: &str) -> bool {
        self.tensors.contains_key(name)
    }

    /// Number of bytes of a tensor.
    pub fn size(&self, name: &str) -> Result<usize, MapError> {
        let (from, to) = self.tensor(name)?.data_offsets;
        Ok(to - from)
    }

    pub fn shape(&self, name: &str, dtype: Dtype) -> Result<&[usize], MapError> {
        let tensor = self.tensor(name)?;
        if tensor.dtype != dtype {
            return Err(MapError::Damaged(format!("{name} is of {:?}, expected {dtype:?}", tensor.dtype)));
        }
        Ok(&tensor.shape)
    }

    /// A tensor's bytes.
    pub fn bytes(&self, name: &str) -> Result<Vec<u8>, MapError> {
        self.bytes_in(name, 0..self.size(name)?)
    }

    /// Some of a tensor's bytes.
    ///
    /// # Panics
    /// When the tensor has not as many.
    pub fn bytes_in(&self, name: &str, range: Range<usize>) -> Result<Vec<u8>, MapError> {
        let (from, to) = self.tensor(name)?.data_offsets;
        assert!(range.start <= range.end && range.end <= to - from, "{range:?} of {name}");
        let mut bytes = vec![0; range.len()];
        self.reader.read_exactly_at(self.data + (from + range.start) as u64, &mut bytes)?;
        Ok(bytes)
    }

    fn tensor(&self, name: &str) -> Result<&TensorInfo, MapError> {
        self.tensors.get(name).ok_or_else(|| MapError::Damaged(format!("{name} is missing")))
    }
}

fn bytes_of(dtype: Dtype) -> Option<usize> {
    dtype.bitsize().is_multiple_of(8).then(|| dtype.bitsize() / 8)
}

/// Numbers that a map may hold.
pub trait Number: Sized {
    const DTYPE: Dtype;
    const BYTES: usize;
    fn parse(bytes: &[u8]) -> Self;
    fn is_finite(&self) -> bool;
}

macro_rules! number {
    ($type:ty, $dtype:expr, $is_finite:expr) => {
        impl Number for $type {
            const DTYPE: Dtype = $dtype;
            const BYTES: usize = size_of::<$type>();
            fn parse(bytes: &[u8]) -> Self {
                Self::from_le_bytes(bytes.try_into().expect("as many as a number has"))
            }
            fn is_finite(&self) -> bool {
                $is_finite(*self)
            }
        }
    };
}

number!(f64, Dtype::F64, f64::is_finite);
number!(f32, Dtype::F32, f32::is_finite);
number!(u32, Dtype::U32, |_| true);
number!(i8, Dtype::I8, |_| true);

/// The numbers that `bytes`, of the tensor `name`, stand for.
pub fn numbers<T: Number>(name: &str, bytes: &[u8]) -> Result<Vec<T>, MapError> {
    let numbers: Vec<T> = bytes.chunks_exact(T::BYTES).map(T::parse).collect();
    if numbers.iter().any(|number| !number.is_finite()) {
        return Err(MapError::Damaged(format!("{name} holds a value that is no finite number")));
    }
    Ok(numbers)
}
