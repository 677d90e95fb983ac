//! Simulated places: a town block, a corridor and a hall, seen through a donut lens while a vehicle drives through them.
//!
//! Everything follows from seeds. A [`World`] is a place; a [`Day`] is its light, its parked cars, its traffic and people; a
//! [`Drive`] says where the vehicle is at any instant; a [`Receiver`] says what a satellite receiver makes of that; a
//! [`Camera`] is a lens and where it is mounted; and a [`Renderer`] makes the frames:
//!
//! ```
//! use omniloc::world::{Camera, Day, Drive, DriveSettings, Renderer, World};
//!
//! let world = World::corridor(1);
//! let drive = Drive::new(&world, &DriveSettings::default());
//! let mut renderer = Renderer::new(&world, &Day::new(1), &Camera::corridor())?;
//! let mut jpeg = Vec::new();
//! renderer.render_jpeg(&drive.pose_at(2.5), 2.5, &mut jpeg);
//! # Ok::<(), omniloc::world::CameraError>(())
//! ```
//!
//! Rendering is the inner loop of every simulated drive, so it is made for speed on one core: for each of 2048 directions
//! the blocks that a ray meets are found, and painted from far to near into one column of a panorama with textures that
//! were filtered for every distance beforehand; a table made once per lens then bends the panorama into the donut.

mod camera;
mod column;
mod corridor;
mod day;
mod dress;
mod drive;
mod gnss;
mod hall;
mod light;
mod paint;
mod path;
mod random;
mod render;
mod scene;
mod sensor;
mod survey;
#[cfg(test)]
mod tests;
mod texture;
mod town;
mod traffic;

pub use camera::{Camera, CameraError};
pub use day::{Day, Season};
pub use drive::{Drive, DriveSettings, Pose};
pub use gnss::{Outages, Receiver, ReceiverSample, ReceiverSettings};
pub use render::Renderer;

use std::{ops::RangeInclusive, sync::Arc};

use path::Corner;
use scene::{Block, Plane, Upright};
use texture::{Color, Texture};
use town::Streets;

use crate::types::Geodetic;

/// A place. Another seed is another place.
#[derive(Debug, Clone)]
pub struct World {
    kind: WorldKind,
    /// Where x = y = 0 lies on the Earth.
    pub origin: Geodetic,
    textures: Vec<Arc<Texture>>,
    blocks: Vec<Block>,
    uprights: Vec<Upright>,
    ground: Plane,
    ceiling: Option<Plane>,
    lamps: Vec<Lamp>,
    /// Textures of window panes, which are as bright as the day outside.
    panes: Vec<u16>,
    /// Textures of trees, which change with the season.
    trees: Vec<u16>,
    parking: Vec<Parking>,
}

#[derive(Debug, Clone, Copy)]
enum WorldKind {
    Town(Streets),
    Corridor { length_m: f64 },
    Hall,
}

/// A rectangle on the ceiling that shines.
#[derive(Debug, Clone, Copy)]
struct Lamp {
    center_m: [f32; 2],
    half_m: [f32; 2],
}

/// Where a car may be parked.
#[derive(Debug, Clone, Copy)]
struct Parking {
    center_m: [f32; 2],
    direction: [f32; 2],
}

/// Length of the corridor that is driven through, if nothing else is said \[m\].
const CORRIDOR_LENGTH_M: f64 = 7.0;
/// Where worlds lie if nothing else is said: somewhere at sea, so that nobody takes a simulated drive for a real one.
const DEFAULT_ORIGIN: Geodetic = Geodetic { latitude_deg: 54.5, longitude_deg: 4.5, altitude_m: 40.0 };

impl World {
    /// What a corridor may measure: more would only be more of the same \[m\].
    pub const CORRIDOR_LENGTHS_M: RangeInclusive<f64> = 3.0..=100.0;

    /// Streets around a block of houses of about 60 × 90 m, with side streets.
    pub fn town_block(seed: u64) -> Self {
        town::build(seed)
    }

    /// A corridor of which 7 × 2.7 m are driven through.
    pub fn corridor(seed: u64) -> Self {
        Self::corridor_of_length(seed, CORRIDOR_LENGTH_M)
    }

    /// A corridor of which `length_m` × 2.7 m are driven through; lengths beyond
    /// [`CORRIDOR_LENGTHS_M`](Self::CORRIDOR_LENGTHS_M) are taken as the nearer end.
    pub fn corridor_of_length(seed: u64, length_m: f64) -> Self {
        corridor::build(seed, length_m.max(*Self::CORRIDOR_LENGTHS_M.start()).min(*Self::CORRIDOR_LENGTHS_M.end()))
    }

    /// A hall of 44 × 38 m between whose stands, shelves and columns there are aisles.
    pub fn hall(seed: u64) -> Self {
        hall::build(seed)
    }

    /// The same place somewhere else on the Earth.
    pub fn with_origin(self, origin: Geodetic) -> Self {
        Self { origin, ..self }
    }

    pub fn is_outdoors(&self) -> bool {
        matches!(self.kind, WorldKind::Town(_))
    }

    fn empty(kind: WorldKind, ground: Plane) -> Self {
        Self {
            kind,
            origin: DEFAULT_ORIGIN,
            textures: Vec::new(),
            blocks: Vec::new(),
            uprights: Vec::new(),
            ground,
            ceiling: None,
            lamps: Vec::new(),
            panes: Vec::new(),
            trees: Vec::new(),
            parking: Vec::new(),
        }
    }

    fn route(&self, laps: u32, lane_shift_m: f64) -> Vec<Corner> {
        match &self.kind {
            WorldKind::Town(streets) => streets.route(laps, town::LANE_M + lane_shift_m),
            WorldKind::Corridor { length_m } => corridor::route(*length_m, lane_shift_m),
            WorldKind::Hall => hall::route(lane_shift_m),
        }
    }

    fn add_texture(&mut self, texture: Texture) -> u16 {
        self.textures.push(Arc::new(texture));
        u16::try_from(self.textures.len() - 1).expect("a world has far fewer than 65536 textures")
    }

    /// A texture of one colour, for whatever is too small for more.
    fn add_plain(&mut self, color: Color) -> u16 {
        self.add_texture(Texture::new(1, 1, vec![color], 1.0))
    }
}
