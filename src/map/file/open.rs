//! A map's way out of a file: what it says of the whole at once, the rest when it is asked for.

use std::ops::Range;

use faer::Mat;

use super::tensors::{Number, ReadAt, TensorFile, numbers};
use super::{CHECKSUM, COMPASS_SIGNATURES, COMPASS_YAWS, FIELDS, FORMAT_VERSION, MapError, checksum, sums_of};
use crate::features::COMPASS_BYTES;
use crate::features::scaling::Scaling;
use crate::map::{Block, CandidateCells, Compass, FeatureMap, GroupHyperparameters, GroupInfo, MapGroup, MapInfo};
use crate::types::PositionM;

/// A map whose fields, learning features and signatures are still in its file.
pub struct OpenMap {
    pub info: MapInfo,
    /// Learning positions \[m\].
    pub positions_m: Vec<PositionM>,
    pub cells: CandidateCells,
    /// In the order of [`MapInfo::groups`].
    pub scalings: Vec<Scaling>,
    pub blocks: Vec<Block>,
    file: TensorFile,
    fields: Parts,
    /// Headings of the learning panoramas and where their signatures are, if the map has a compass.
    compass: Option<(Vec<f64>, Parts)>,
}

/// The posterior of a group's features on some cells.
#[derive(Debug, Clone, PartialEq)]
pub struct GroupField {
    /// Feature × cell.
    pub mean: Vec<f32>,
    /// With the noise: feature × cell, or one row that all features share.
    pub variance: Vec<f32>,
}

/// Where the parts of a tensor begin and end, in bytes, and their sums.
struct Parts {
    ends: Vec<usize>,
    sums: Vec<u32>,
}

impl OpenMap {
    /// Reads what a map says of the whole, and checks it.
    ///
    /// # Errors
    /// Says whether the file is no map, of another version, or damaged, and where.
    pub fn open(reader: Box<dyn ReadAt>) -> Result<Self, MapError> {
        let file = TensorFile::open(reader)?;
        let not_a_map = |error: &dyn std::fmt::Display| MapError::NotAMap(error.to_string());
        // The version first: the rest of another version's information may look different.
        let json: serde_json::Value = serde_json::from_str(&file.info).map_err(|error| not_a_map(&error))?;
        match json["format_version"].as_u64() {
            Some(found) if found != u64::from(FORMAT_VERSION) => return Err(MapError::UnsupportedVersion { found }),
            Some(_) => {}
            None => return Err(not_a_map(&"its format_version is not a whole number")),
        }
        check_sum(&file)?;
        let info: MapInfo = serde_json::from_value(json).map_err(|error| MapError::Damaged(error.to_string()))?;
        info.check().map_err(MapError::Damaged)?;
        Self::parse(file, info)
    }

    fn parse(file: TensorFile, info: MapInfo) -> Result<Self, MapError> {
        let positions: Vec<f64> = rows(&file, "positions_m", 2)?;
        if positions.is_empty() {
            return Err(MapError::Damaged("it has no learning positions".into()));
        }
        let cells: Vec<u32> = rows(&file, "cells", 2)?;
        let cells = cells.as_chunks::<2>().0.to_vec();
        let cells = CandidateCells::from_parts(info.grid, cells).map_err(MapError::Damaged)?;
        let scaling = |group: &GroupInfo| {
            let (d, k) = (group.recipe.descriptor.dimensions(), group.features);
            let name = |part: &str| format!("{}/{part}", group.recipe.descriptor);
            let mean = exactly(&file, &name("mean"), &[d])?;
            let projection: Vec<f64> = exactly(&file, &name("projection"), &[k, d])?;
            Ok(Scaling { mean, projection: Mat::from_fn(k, d, |r, i| projection[r * d + i]) })
        };
        let scalings = info.groups.iter().map(scaling).collect::<Result<_, MapError>>()?;
        let blocks = Block::all_of(&cells);
        let row_count: usize = info.groups.iter().map(|group| group.features + variance_rows(group)).sum();
        let sizes = blocks.iter().map(|block| row_count * block.cells.len());
        let fields = Parts::of::<f32>(&file, FIELDS, &[row_count * cells.len()], sizes)?;
        let n = positions.len() / 2;
        let compass = match info.heading_std_rad {
            None => None,
            Some(_) => {
                let yaws_rad: Vec<f64> = exactly(&file, COMPASS_YAWS, &[n])?;
                if let Some(bad) = yaws_rad.iter().find(|yaw_rad| yaw_rad.abs() > 100.0) {
                    return Err(MapError::Damaged(format!("{COMPASS_YAWS} holds {bad}")));
                }
                let (shape, sizes) = ([n, COMPASS_BYTES], std::iter::repeat_n(COMPASS_BYTES, n));
                Some((yaws_rad, Parts::of::<i8>(&file, COMPASS_SIGNATURES, &shape, sizes)?))
            }
        };
        let positions_m = positions.as_chunks::<2>().0.to_vec();
        Ok(Self { info, positions_m, cells, scalings, blocks, file, fields, compass })
    }

    /// Number of bytes of the fields.
    pub fn fields_bytes(&self) -> usize {
        self.fields.ends.last().copied().unwrap_or(0)
    }

    /// Number of bytes of the fields of a block.
    pub fn block_bytes(&self, block: usize) -> usize {
        self.fields.range(block).len()
    }

    /// Every group's field on the cells of a block.
    ///
    /// # Errors
    /// When the block cannot be read, or is damaged.
    pub fn fields_of_block(&self, block: usize) -> Result<Vec<GroupField>, MapError> {
        let values: Vec<f32> = numbers(FIELDS, &self.fields.read(&self.file, FIELDS, block)?)?;
        let cells = self.blocks[block].cells.len();
        let mut rest = values.as_slice();
        let fields = self.info.groups.iter().map(|group| {
            let (mean, variance);
            (mean, rest) = rest.split_at(group.features * cells);
            (variance, rest) = rest.split_at(variance_rows(group) * cells);
            if let Some(bad) = variance.iter().find(|&&v| v <= 0.0) {
                return Err(MapError::Damaged(format!("{FIELDS} holds a variance of {bad}")));
            }
            Ok(GroupField { mean: mean.to_vec(), variance: variance.to_vec() })
        });
        fields.collect()
    }

    /// Every group's field on all cells.
    ///
    /// # Errors
    /// As [`fields_of_block`](Self::fields_of_block).
    pub fn all_fields(&self) -> Result<Vec<GroupField>, MapError> {
        let c = self.cells.len();
        let empty = |group: &GroupInfo| GroupField {
            mean: vec![0.0; group.features * c],
            variance: vec![0.0; variance_rows(group) * c],
        };
        let mut all: Vec<GroupField> = self.info.groups.iter().map(empty).collect();
        for (number, block) in self.blocks.iter().enumerate() {
            for (all, of_block) in all.iter_mut().zip(self.fields_of_block(number)?) {
                for (to, from) in [(&mut all.mean, of_block.mean), (&mut all.variance, of_block.variance)] {
                    let rows = to.chunks_exact_mut(c).zip(from.chunks_exact(block.cells.len()));
                    rows.for_each(|(to, from)| {
                        block.cells.iter().zip(from).for_each(|(&cell, &value)| to[cell as usize] = value);
                    });
                }
            }
        }
        Ok(all)
    }

    /// The compass, of the learning panoramas whose positions are wanted; `None` if the map has none.
    ///
    /// # Errors
    /// When signatures cannot be read, or are damaged.
    pub fn compass(&self, is_wanted: impl Fn(PositionM) -> bool) -> Result<Option<Compass>, MapError> {
        let Some((yaws_rad, signatures)) = &self.compass else { return Ok(None) };
        let mut compass = Compass {
            positions_m: Vec::new(),
            yaws_rad: Vec::new(),
            signatures: Vec::new(),
            sense: Compass::sense_of(self.info.calibration.azimuth),
            std_rad: self.info.heading_std_rad.unwrap_or_default(),
        };
        for (i, &position_m) in self.positions_m.iter().enumerate().filter(|(_, position_m)| is_wanted(**position_m)) {
            compass.positions_m.push(position_m);
            compass.yaws_rad.push(yaws_rad[i]);
            let bytes = signatures.read(&self.file, COMPASS_SIGNATURES, i)?;
            compass.signatures.extend(bytes.into_iter().map(u8::cast_signed));
        }
        Ok(Some(compass))
    }

    /// The whole map.
    ///
    /// # Errors
    /// When a part of it cannot be read, or is damaged.
    pub fn into_map(self) -> Result<FeatureMap, MapError> {
        let n = self.positions_m.len();
        let learning = |group: &GroupInfo| {
            let (k, name) = (group.features, format!("{}/learning", group.recipe.descriptor));
            let parts = Parts::of::<f64>(&self.file, &name, &[n, k], std::iter::once(n * k))?;
            let values: Vec<f64> = numbers(&name, &parts.read(&self.file, &name, 0)?)?;
            Ok(Mat::from_fn(n, k, |i, r| values[i * k + r]))
        };
        let learning: Vec<Mat<f64>> = self.info.groups.iter().map(learning).collect::<Result<_, MapError>>()?;
        let fields = self.all_fields()?;
        let compass = self.compass(|_| true)?;
        let groups = self.scalings.into_iter().zip(learning).zip(fields).map(|((scaling, learning), field)| MapGroup {
            scaling,
            learning,
            field_mean: field.mean,
            field_variance: field.variance,
        });
        let groups = groups.collect();
        Ok(FeatureMap { info: self.info, positions_m: self.positions_m, cells: self.cells, groups, compass })
    }
}

/// Features that share their hyperparameters share the variance.
fn variance_rows(group: &GroupInfo) -> usize {
    match group.hyperparameters {
        GroupHyperparameters::Shared(_) => 1,
        GroupHyperparameters::Each(_) => group.features,
    }
}

/// Checks everything that has no sums of its own.
fn check_sum(file: &TensorFile) -> Result<(), MapError> {
    let names = file.names();
    let covered: Vec<&String> = names.iter().filter(|name| *name != CHECKSUM && !file.has(&sums_of(name))).collect();
    let tensors: Vec<Vec<u8>> = covered.iter().map(|name| file.bytes(name)).collect::<Result<_, _>>()?;
    let found = checksum(&file.info, covered.iter().map(|name| name.as_str()).zip(tensors.iter().map(Vec::as_slice)));
    if !file.has(CHECKSUM) {
        return Err(MapError::Damaged("it has no checksum".into()));
    }
    // A fuzzer would never get past it.
    if !cfg!(fuzzing) && file.bytes(CHECKSUM)? != found { Err(MapError::Checksum) } else { Ok(()) }
}

impl Parts {
    /// Those of a tensor of this shape, which have so many numbers each.
    fn of<T: Number>(
        file: &TensorFile,
        name: &str,
        shape: &[usize],
        sizes: impl Iterator<Item = usize>,
    ) -> Result<Self, MapError> {
        check_shape::<T>(file, name, shape)?;
        let after = |end: &mut usize, size: usize| {
            *end += size * T::BYTES;
            Some(*end)
        };
        let ends: Vec<usize> = sizes.scan(0, after).collect();
        let sums = exactly(file, &sums_of(name), &[ends.len()])?;
        Ok(Self { ends, sums })
    }

    fn range(&self, part: usize) -> Range<usize> {
        part.checked_sub(1).map_or(0, |before| self.ends[before])..self.ends[part]
    }

    /// The bytes of a part, checked.
    fn read(&self, file: &TensorFile, name: &str, part: usize) -> Result<Vec<u8>, MapError> {
        let bytes = file.bytes_in(name, self.range(part))?;
        if !cfg!(fuzzing) && crc32fast::hash(&bytes) != self.sums[part] {
            return Err(MapError::Damaged(format!("part {part} of {name} does not fit its checksum")));
        }
        Ok(bytes)
    }
}

/// The numbers of a tensor of this shape.
fn exactly<T: Number>(file: &TensorFile, name: &str, expected: &[usize]) -> Result<Vec<T>, MapError> {
    check_shape::<T>(file, name, expected)?;
    numbers(name, &file.bytes(name)?)
}

fn check_shape<T: Number>(file: &TensorFile, name: &str, expected: &[usize]) -> Result<(), MapError> {
    match file.shape(name, T::DTYPE)? {
        shape if shape == expected => Ok(()),
        shape => Err(MapError::Damaged(format!("{name} is {shape:?}, expected {expected:?}"))),
    }
}

/// The numbers of a tensor of so many columns.
fn rows<T: Number>(file: &TensorFile, name: &str, columns: usize) -> Result<Vec<T>, MapError> {
    match *file.shape(name, T::DTYPE)? {
        [_, found] if found == columns => numbers(name, &file.bytes(name)?),
        ref shape => Err(MapError::Damaged(format!("{name} is {shape:?}, expected [_, {columns}]"))),
    }
}
