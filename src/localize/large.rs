//! Maps that are larger than memory: frames are matched with the part of the map that the vehicle is in.
//!
//! As long as the position is known, a *window* of whole blocks around it is all that is read from the file and matched, so
//! that a frame costs the same however large the map is. Everything is searched while the position is not known, and also
//! when a frame fits nowhere in the window as well as frames of the map do: whoever was carried off is noticed. Such
//! searches are spared until the frames since the last one have cost as much as it did.

use std::ops::Range;

use super::belief::Mode;
use super::likelihood::MapFields;
use super::motion::MotionSettings;
use super::tracker::Tracker;
use crate::map::{BLOCK_SIDE, CandidateCells, MapError, OpenMap};
use crate::types::{LocalizationState, PositionM, distance_m};

/// A window has room for so many steps of the grid around the position, at least.
const NEAR_STEPS: f64 = 12.0;
/// And for so many deviations of it.
const NEAR_STDS: f64 = 4.0;
/// A new window is wider by so many steps, so that it lasts a while.
const LASTING_STEPS: f64 = 16.0;
/// The vehicle gets faster by at most so many deviations of what the settings say.
const ACCELERATION_STDS: f64 = 3.0;
/// A position that needs a wider window is looked for everywhere; and headings are taken from so far \[steps\].
const WIDEST_STEPS: f64 = 64.0;

pub struct LargeMap {
    map: OpenMap,
    /// Fields that may stay in memory \[bytes\].
    memory_bytes: usize,
    motion: MotionSettings,
    /// A block each.
    loaded: Vec<Option<Loaded>>,
    loaded_bytes: usize,
    /// Counts up with every use of a block.
    uses: u64,
    /// `None`: everywhere.
    window: Option<Window>,
    /// What the present headings are taken from lies about here.
    compass_m: Option<PositionM>,
    /// So many frames more until everything may be searched because of a strange frame.
    spared: usize,
    /// Of one block.
    of_block: Vec<f32>,
}

struct Loaded {
    fields: MapFields,
    last_used: u64,
}

/// Whole blocks.
struct Window {
    columns: Range<u32>,
    rows: Range<u32>,
    cells: CandidateCells,
    /// The blocks, and where their cells are among `cells`.
    blocks: Vec<(usize, Vec<u32>)>,
}

/// A frame as it is matched.
pub struct Features<'a> {
    pub stamp_ns: u64,
    /// Of all groups, one behind the other.
    pub features: &'a [f32],
    /// Log-likelihood of no place, if the map can say.
    pub nowhere: Option<f32>,
}

impl LargeMap {
    pub fn new(map: OpenMap, memory_bytes: usize, motion: MotionSettings) -> Self {
        let loaded = map.blocks.iter().map(|_| None).collect();
        Self {
            map,
            memory_bytes,
            motion,
            loaded,
            loaded_bytes: 0,
            uses: 0,
            window: None,
            compass_m: None,
            spared: 0,
            of_block: Vec::new(),
        }
    }

    /// The log-likelihood of a frame at every cell that `tracker` is to look at, which is told first.
    ///
    /// # Errors
    /// When the map's file cannot be read any more, or what is read is damaged.
    pub fn match_frame(
        &mut self,
        frame: &Features,
        tracker: &mut Tracker,
        scratch: &mut Vec<f32>,
        log_likelihood: &mut Vec<f32>,
    ) -> Result<(), MapError> {
        self.choose_window(frame, tracker)?;
        self.match_chosen(frame.features, scratch, log_likelihood)?;
        self.spared = self.spared.saturating_sub(1);
        let Some(window) = self.window.as_ref().filter(|_| self.spared == 0) else { return Ok(()) };
        if self.is_strange(frame, log_likelihood) {
            self.spared = self.map.cells.len() / window.cells.len();
            self.look_everywhere(tracker);
            self.match_chosen(frame.features, scratch, log_likelihood)?;
        }
        Ok(())
    }

    /// Whether a frame of the window's cells would resemble them more.
    fn is_strange(&self, frame: &Features, log_likelihood: &[f32]) -> bool {
        let best = log_likelihood.iter().copied().fold(f32::NEG_INFINITY, f32::max);
        let least = self.map.info.least_resemblance.map(|least| least * self.map.info.temperature);
        frame.nowhere.zip(least).is_none_or(|(nowhere, least)| f64::from(best - nowhere) < least)
    }

    fn choose_window(&mut self, frame: &Features, tracker: &mut Tracker) -> Result<(), MapError> {
        let grid = self.map.cells.grid;
        let hill = tracker.hill();
        self.turn_near(&hill, tracker)?;
        let can_tell_strange_frames = frame.nowhere.is_some() && self.map.info.least_resemblance.is_some();
        if tracker.state() != LocalizationState::Localized || !can_tell_strange_frames {
            self.look_everywhere(tracker);
            return Ok(());
        }
        let std_m = hill.covariance.ee_m2.max(hill.covariance.nn_m2).sqrt();
        let since_s = tracker.since_last_s(frame.stamp_ns);
        let MotionSettings { speed_limit_mps, acceleration_mps2, .. } = self.motion;
        let fastest_mps = tracker.speed_mps().map_or(speed_limit_mps, |speed_mps| {
            (speed_mps + ACCELERATION_STDS * acceleration_mps2 * since_s).min(speed_limit_mps)
        });
        let way_m = fastest_mps * since_s;
        let near = NEAR_STEPS + (NEAR_STDS * std_m + way_m) / grid.step_m;
        if near + LASTING_STEPS > WIDEST_STEPS {
            self.look_everywhere(tracker);
            return Ok(());
        }
        let middle = [0, 1].map(|axis| (hill.mean_m[axis] - grid.origin_m[axis]) / grid.step_m);
        let [columns, rows] = self.part(middle, near);
        if self.window.as_ref().is_some_and(|window| window.covers(&columns, &rows)) {
            return Ok(());
        }
        let [columns, rows] = self.part(middle, near + LASTING_STEPS);
        let window = Window::new(&self.map, whole_blocks(columns, grid.columns), whole_blocks(rows, grid.rows));
        match &window {
            Some(window) => tracker.look_at(&window.cells),
            // Between cells that are far apart.
            None => self.look_everywhere(tracker),
        }
        self.window = window;
        Ok(())
    }

    /// Has headings taken from the panoramas about where the vehicle seems to be, whether that may be said yet or not.
    fn turn_near(&mut self, hill: &Mode, tracker: &mut Tracker) -> Result<(), MapError> {
        let (at_m, step_m) = (hill.mean_m, self.map.cells.grid.step_m);
        let is_near = |compass_m| distance_m(compass_m, at_m) < LASTING_STEPS * step_m;
        if tracker.state() == LocalizationState::Unknown || self.compass_m.is_some_and(is_near) {
            return Ok(());
        }
        tracker.turn_by(self.map.compass(|position_m| distance_m(position_m, at_m) < WIDEST_STEPS * step_m)?);
        self.compass_m = Some(at_m);
        Ok(())
    }

    /// Columns and rows within `reach` steps of `middle`, in the grid.
    fn part(&self, middle: [f64; 2], reach: f64) -> [Range<u32>; 2] {
        let grid = self.map.cells.grid;
        [(middle[0], grid.columns), (middle[1], grid.rows)].map(|(at, count)| {
            let last = f64::from(count - 1);
            let (from, to) = ((at - reach).floor().clamp(0.0, last), (at + reach).ceil().clamp(0.0, last));
            from as u32..to as u32 + 1
        })
    }

    fn look_everywhere(&mut self, tracker: &mut Tracker) {
        if self.window.take().is_some() {
            tracker.look_at(&self.map.cells);
        }
    }

    fn match_chosen(
        &mut self,
        features: &[f32],
        scratch: &mut Vec<f32>,
        log_likelihood: &mut Vec<f32>,
    ) -> Result<(), MapError> {
        log_likelihood.clear();
        if let Some(window) = self.window.take() {
            log_likelihood.resize(window.cells.len(), 0.0);
            let outcome = window.blocks.iter().try_for_each(|(block, places)| {
                self.load(*block, &window)?;
                self.match_block(*block, None, features, scratch);
                places.iter().zip(&self.of_block).for_each(|(&place, &value)| log_likelihood[place as usize] = value);
                Ok(())
            });
            self.window = Some(window);
            return outcome;
        }
        log_likelihood.resize(self.map.cells.len(), 0.0);
        for block in 0..self.loaded.len() {
            // What is read only now does not stay.
            let passing = if self.loaded[block].is_none() { Some(self.read(block)?) } else { None };
            self.match_block(block, passing.as_ref(), features, scratch);
            let cells = &self.map.blocks[block].cells;
            cells.iter().zip(&self.of_block).for_each(|(&cell, &value)| log_likelihood[cell as usize] = value);
        }
        Ok(())
    }

    /// The log-likelihood at the cells of a block: of these fields, or those that are in memory.
    fn match_block(&mut self, block: usize, fields: Option<&MapFields>, features: &[f32], scratch: &mut Vec<f32>) {
        self.of_block.clear();
        self.of_block.resize(self.map.blocks[block].cells.len(), 0.0);
        let fields = fields.or(self.loaded[block].as_ref().map(|loaded| &loaded.fields)).expect("read before");
        fields.add_log_likelihood(features, scratch, &mut self.of_block);
    }

    fn read(&self, block: usize) -> Result<MapFields, MapError> {
        let cells = self.map.blocks[block].cells.len();
        Ok(MapFields::new(&self.map.info.groups, cells, self.map.fields_of_block(block)?))
    }

    /// Sees to it that a block of the window is in memory; those that were longest not needed make room.
    fn load(&mut self, block: usize, window: &Window) -> Result<(), MapError> {
        self.uses += 1;
        let last_used = self.uses;
        if let Some(loaded) = &mut self.loaded[block] {
            loaded.last_used = last_used;
            return Ok(());
        }
        self.loaded[block] = Some(Loaded { fields: self.read(block)?, last_used });
        self.loaded_bytes += self.map.block_bytes(block);
        while self.loaded_bytes > self.memory_bytes {
            let is_needed = |candidate: usize| window.blocks.iter().any(|(block, _)| *block == candidate);
            let others = self.loaded.iter().enumerate().filter(|(other, _)| !is_needed(*other));
            let oldest = others.filter_map(|(other, loaded)| Some((loaded.as_ref()?.last_used, other))).min();
            let Some((_, oldest)) = oldest else { break };
            self.loaded[oldest] = None;
            self.loaded_bytes -= self.map.block_bytes(oldest);
        }
        Ok(())
    }
}

impl Window {
    /// `None` where no candidate is.
    fn new(map: &OpenMap, columns: Range<u32>, rows: Range<u32>) -> Option<Self> {
        let cells = map.cells.within(columns.clone(), rows.clone())?;
        let is_inside = |corner: [u32; 2]| columns.contains(&corner[0]) && rows.contains(&corner[1]);
        let inside = map.blocks.iter().enumerate().filter(|(_, block)| is_inside(block.corner));
        let blocks = inside.map(|(number, block)| {
            let place = |&cell: &u32| {
                let [i, j] = map.cells.indices()[cell as usize];
                cells.index_of([i - columns.start, j - rows.start]).expect("the window has whole blocks") as u32
            };
            (number, block.cells.iter().map(place).collect())
        });
        let blocks = blocks.collect();
        Some(Self { columns, rows, cells, blocks })
    }

    fn covers(&self, columns: &Range<u32>, rows: &Range<u32>) -> bool {
        let covers = |ours: &Range<u32>, other: &Range<u32>| ours.start <= other.start && other.end <= ours.end;
        covers(&self.columns, columns) && covers(&self.rows, rows)
    }
}

fn whole_blocks(part: Range<u32>, count: u32) -> Range<u32> {
    part.start / BLOCK_SIDE * BLOCK_SIDE..part.end.next_multiple_of(BLOCK_SIDE).min(count)
}

#[cfg(test)]
#[path = "large_tests.rs"]
mod tests;
