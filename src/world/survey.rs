//! Photographs taken one by one, standing, facing anywhere: how an indoor place is often surveyed.

use std::f64::consts::PI;

use rand::Rng;
use rand_chacha::ChaCha8Rng;

use super::{
    Pose, World, hall,
    random::{Stream, stream},
};
use crate::types::PositionM;

/// From the camera to whatever stands there \[m\].
const CLEARANCE_M: f32 = 0.45;
/// What begins higher than this stands in nobody's way \[m\].
const HEADROOM_M: f32 = 2.2;

impl World {
    /// One photograph near every point of a square lattice where there is room, moved from it by up to a quarter of
    /// `spacing_m` an axis. Of the hall; other places are driven through and have none.
    pub fn lattice(&self, spacing_m: f64, seed: u64) -> Vec<Pose> {
        let mut random = stream(seed, Stream::Path);
        let size_m = self.open_size_m();
        let counts = size_m.map(|length_m| (length_m / spacing_m).round() as usize);
        let mut poses = Vec::with_capacity(counts[0] * counts[1]);
        for i in 0..counts[0] {
            for j in 0..counts[1] {
                let position_m = [(i, 0), (j, 1)].map(|(k, axis)| {
                    let middle_m = (k as f64 + 0.5) * size_m[axis] / counts[axis] as f64;
                    middle_m + 0.25 * spacing_m * random.random_range(-1.0..1.0)
                });
                let pose = facing_anywhere(position_m, &mut random);
                poses.extend(self.has_room(position_m).then_some(pose));
            }
        }
        poses
    }

    /// `count` photographs at random places where there is room. Of the hall, as [`lattice`](Self::lattice).
    pub fn scattered(&self, count: usize, seed: u64) -> Vec<Pose> {
        let mut random = stream(seed, Stream::Path);
        let size_m = self.open_size_m();
        let anywhere = std::iter::repeat_with(|| {
            let position_m = size_m.map(|length_m| length_m * random.random::<f64>());
            facing_anywhere(position_m, &mut random)
        });
        let wanted = if size_m[0] > 0.0 { count } else { 0 };
        anywhere.filter(|pose| self.has_room(pose.position_m)).take(wanted).collect()
    }

    fn open_size_m(&self) -> [f64; 2] {
        match self.kind {
            super::WorldKind::Hall => hall::SIZE_M,
            super::WorldKind::Town(_) | super::WorldKind::Corridor { .. } => [0.0; 2],
        }
    }

    fn has_room(&self, position_m: PositionM) -> bool {
        let at_m = position_m.map(|coordinate| coordinate as f32);
        let beside_blocks = self.blocks.iter().filter(|block| block.bottom_m < HEADROOM_M).all(|block| {
            let [x, y] = block.local(at_m);
            (x.abs() - block.half_m[0]).max(y.abs() - block.half_m[1]) > CLEARANCE_M
        });
        let beside_uprights = self.uprights.iter().all(|upright| {
            let [x, y] = [0, 1].map(|axis| at_m[axis] - upright.center_m[axis]);
            x.hypot(y) > upright.half_width_m + CLEARANCE_M
        });
        beside_blocks && beside_uprights
    }
}

fn facing_anywhere(position_m: PositionM, random: &mut ChaCha8Rng) -> Pose {
    Pose::at(position_m, random.random_range(-PI..PI))
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::types::distance_m;

    #[test]
    fn a_survey_keeps_its_spacing_and_stands_in_nothing() {
        let world = World::hall(1);
        let poses = world.lattice(1.6, 1);
        // Two thirds of 44 x 38 m and more are open.
        assert!((400..660).contains(&poses.len()), "{}", poses.len());
        let mut nearest_m: Vec<f64> = poses
            .iter()
            .map(|pose| {
                let others = poses.iter().map(|other| distance_m(pose.position_m, other.position_m));
                others.filter(|&d| d > 0.0).fold(f64::INFINITY, f64::min)
            })
            .collect();
        nearest_m.sort_unstable_by(f64::total_cmp);
        let median_m = nearest_m[nearest_m.len() / 2];
        assert!((1.0..1.6).contains(&median_m) && nearest_m[0] > 0.75, "{median_m} m, least {} m", nearest_m[0]);
        let mean_cos = poses.iter().map(|pose| pose.yaw_rad.cos()).sum::<f64>() / poses.len() as f64;
        assert!(mean_cos.abs() < 0.15, "headings lean by {mean_cos}");
        assert!(poses.iter().all(|pose| world.has_room(pose.position_m)));
    }

    #[test]
    fn random_places_follow_from_the_seed_and_only_halls_have_them() {
        let world = World::hall(2);
        let poses = world.scattered(150, 7);
        assert_eq!(poses.len(), 150);
        assert_eq!(poses, world.scattered(150, 7));
        assert_ne!(poses, world.scattered(150, 8));
        for other in [World::town_block(1), World::corridor(1)] {
            assert!(other.scattered(10, 1).is_empty() && other.lattice(1.6, 1).is_empty());
        }
    }
}
