//! A vehicle's way through the world: where it is at any instant.

use std::f64::consts::TAU;

use rand::Rng;

use super::{
    World,
    path::{Path, Smoothing},
    random::{Stream, stream},
};
use crate::types::{PositionM, wrap_angle_rad};

/// Largest acceleration and deceleration in the direction of travel \[m/s²\].
const MAX_ACCELERATION_MPS2: f64 = 1.6;
const MAX_DECELERATION_MPS2: f64 = 1.8;
/// Distance of the nodes of the speed profile \[m\].
const TOWN_NODE_M: f64 = 0.25;
const CORRIDOR_NODE_M: f64 = 0.02;

/// Where the vehicle is and how it moves.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct Pose {
    /// East, north \[m\] from the world's origin; of the camera, which also is where the antenna is.
    pub position_m: PositionM,
    /// From east, counter-clockwise, in (−π, π].
    pub yaw_rad: f64,
    pub speed_mps: f64,
    pub yaw_rate_radps: f64,
}

impl Pose {
    /// Standing still.
    pub fn at(position_m: PositionM, yaw_rad: f64) -> Self {
        Self { position_m, yaw_rad, speed_mps: 0.0, yaw_rate_radps: 0.0 }
    }
}

/// How a place is driven through.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct DriveSettings {
    /// Chooses speeds, stops and how the driver strays in his lane.
    pub seed: u64,
    /// Laps in each direction before the drive begins anew (town).
    pub laps: u32,
    /// How much further to the right than the middle of the lane the vehicle is driven.
    pub lane_shift_m: f64,
    /// Factor on all speeds: 1 is up to about 11 m/s in town and 0.9 m/s in the corridor.
    pub speed_factor: f64,
}

impl Default for DriveSettings {
    fn default() -> Self {
        Self { seed: 0, laps: 1, lane_shift_m: 0.0, speed_factor: 1.0 }
    }
}

impl DriveSettings {
    /// # Errors
    /// What is wrong with them, in words.
    pub fn check(&self) -> Result<(), String> {
        if !(1..=100).contains(&self.laps) {
            return Err(format!("laps is {}, expected 1 to 100", self.laps));
        }
        let shifts_m = -1.5..=1.5;
        if !shifts_m.contains(&self.lane_shift_m) {
            return Err(format!("lane_shift_m is {}, expected -1.5 to 1.5", self.lane_shift_m));
        }
        if !(0.05..=1.5).contains(&self.speed_factor) {
            return Err(format!("speed_factor is {}, expected 0.05 to 1.5", self.speed_factor));
        }
        Ok(())
    }
}

/// A drive along a closed route, again and again.
///
/// In town it goes round the block counter-clockwise, out into a side street, turns there, and goes round clockwise; it
/// keeps to the right, brakes for corners and stops now and then. In the corridor it goes up and down in parallel lines.
#[derive(Debug, Clone)]
pub struct Drive {
    path: Path,
    nodes: Vec<Node>,
}

/// The vehicle passes here; between nodes the acceleration is constant.
#[derive(Debug, Clone, Copy)]
struct Node {
    distance_m: f64,
    speed_mps: f64,
    arrival_s: f64,
    /// Later than the arrival where the vehicle stops.
    departure_s: f64,
}

impl Drive {
    /// # Panics
    /// When the settings do not pass their [`check`](DriveSettings::check).
    pub fn new(world: &World, settings: &DriveSettings) -> Self {
        settings.check().expect("whoever read the settings checked them");
        let mut random = stream(settings.seed, Stream::Path);
        let in_town = world.is_outdoors();
        let smoothing = Smoothing {
            spacing_m: if in_town { 0.1 } else { 0.01 },
            reach_m: if in_town { 1.0 } else { 0.05 },
            wander_m: if in_town { 0.25 } else { 0.02 },
            wander_length_m: if in_town { 60.0 } else { 4.0 },
            wander_phase_rad: random.random_range(0.0..TAU),
        };
        let path = Path::closed(&world.route(settings.laps, settings.lane_shift_m), smoothing);
        let (node_m, lateral_mps2) = if in_town { (TOWN_NODE_M, 2.0) } else { (CORRIDOR_NODE_M, 0.3) };
        let count = (path.length_m() / node_m).ceil() as usize;
        let step_m = path.length_m() / count as f64;

        // Each stretch has its own cruising speed; some end with a stop. The drive begins and ends at rest.
        let mut dwell_s = vec![0.0; count + 1];
        let mut squares = Vec::with_capacity(count + 1);
        let (slowest, fastest, stretch_m) = if in_town { (6.0, 11.5, 70.0) } else { (0.5, 0.9, 7.0) };
        let (mut cruise_mps, mut stretch_end_m) = (0.0, 0.0);
        for (i, dwell_s) in dwell_s.iter_mut().enumerate() {
            let distance_m = i as f64 * step_m;
            let mut stops = i == 0 || i == count;
            if distance_m >= stretch_end_m {
                stops |= random.random_bool(0.2);
                cruise_mps = random.random_range(slowest..fastest) * settings.speed_factor;
                stretch_end_m = distance_m + stretch_m * random.random_range(0.6..1.4);
            }
            if stops {
                *dwell_s = random.random_range(1.0..5.0);
            }
            let in_corner = lateral_mps2 * settings.speed_factor.min(1.0) / path.at(distance_m).curvature_per_m.abs();
            squares.push(if stops { 0.0 } else { (cruise_mps * cruise_mps).min(in_corner) });
        }
        dwell_s[0] = 0.0;
        for i in 1..=count {
            squares[i] = squares[i].min(squares[i - 1] + 2.0 * MAX_ACCELERATION_MPS2 * step_m);
        }
        for i in (0..count).rev() {
            squares[i] = squares[i].min(squares[i + 1] + 2.0 * MAX_DECELERATION_MPS2 * step_m);
        }

        let mut nodes: Vec<Node> = Vec::with_capacity(count + 1);
        for (i, (square, dwell_s)) in squares.into_iter().zip(dwell_s).enumerate() {
            let speed_mps: f64 = square.sqrt();
            let arrival_s =
                nodes.last().map_or(0.0, |last| last.departure_s + 2.0 * step_m / (last.speed_mps + speed_mps));
            nodes.push(Node { distance_m: i as f64 * step_m, speed_mps, arrival_s, departure_s: arrival_s + dwell_s });
        }
        Self { path, nodes }
    }

    /// Until the vehicle is back where it began and starts again.
    pub fn duration_s(&self) -> f64 {
        self.nodes.last().map_or(0.0, |last| last.departure_s)
    }

    /// Way driven in that time.
    pub fn length_m(&self) -> f64 {
        self.path.length_m()
    }

    pub fn pose_at(&self, time_s: f64) -> Pose {
        let time_s = time_s.rem_euclid(self.duration_s());
        let after = self.nodes.partition_point(|node| node.arrival_s <= time_s).clamp(1, self.nodes.len() - 1);
        let (a, b) = (self.nodes[after - 1], self.nodes[after]);
        let driven_s = (time_s - a.departure_s).clamp(0.0, b.arrival_s - a.departure_s);
        let acceleration_mps2 = (b.speed_mps.powi(2) - a.speed_mps.powi(2)) / (2.0 * (b.distance_m - a.distance_m));
        let stands = time_s < a.departure_s || time_s > b.arrival_s;
        let speed_mps = if stands { 0.0 } else { a.speed_mps + acceleration_mps2 * driven_s };
        let distance_m = a.distance_m + driven_s * (a.speed_mps + 0.5 * acceleration_mps2 * driven_s);
        let point = self.path.at(distance_m.min(b.distance_m));
        Pose {
            position_m: point.position_m,
            yaw_rad: wrap_angle_rad(point.yaw_rad),
            speed_mps,
            yaw_rate_radps: point.curvature_per_m * speed_mps,
        }
    }

    /// When the vehicle has driven `distance_m` of its route, within the first round.
    pub fn time_at_distance_s(&self, distance_m: f64) -> f64 {
        let after = self.nodes.partition_point(|node| node.distance_m <= distance_m).clamp(1, self.nodes.len() - 1);
        let (a, b) = (self.nodes[after - 1], self.nodes[after]);
        let way_m = (distance_m - a.distance_m).clamp(0.0, b.distance_m - a.distance_m);
        let acceleration_mps2 = (b.speed_mps.powi(2) - a.speed_mps.powi(2)) / (2.0 * (b.distance_m - a.distance_m));
        let speed_mps = (a.speed_mps.powi(2) + 2.0 * acceleration_mps2 * way_m).max(0.0).sqrt();
        let mean_mps = 0.5 * (a.speed_mps + speed_mps);
        a.departure_s + if way_m > 0.0 { way_m / mean_mps } else { 0.0 }
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::types::distance_m;

    fn drives() -> [(Drive, f64); 2] {
        let settings = DriveSettings { seed: 4, ..DriveSettings::default() };
        [(Drive::new(&World::town_block(1), &settings), 12.0), (Drive::new(&World::corridor(1), &settings), 1.0)]
    }

    #[test]
    fn speed_and_acceleration_keep_their_limits_and_the_vehicle_stops_and_goes() {
        const STEP_S: f64 = 0.02;
        for (drive, fastest_mps) in drives() {
            let steps = (drive.duration_s() / STEP_S) as usize;
            let poses: Vec<Pose> = (0..=steps).map(|i| drive.pose_at(i as f64 * STEP_S)).collect();
            let (mut moved_m, mut top_mps, mut stands_s) = (0.0, 0.0_f64, 0.0);
            for pair in poses.windows(2) {
                let step_m = distance_m(pair[0].position_m, pair[1].position_m);
                let mean_mps = 0.5 * (pair[0].speed_mps + pair[1].speed_mps);
                // The path is a polygon: a corner cut is a little shorter than the arc.
                assert!((step_m / STEP_S - mean_mps).abs() < 0.02 + 0.01 * mean_mps, "{pair:?}");
                assert!((pair[1].speed_mps - pair[0].speed_mps).abs() / STEP_S < 2.0, "{pair:?}");
                let turned_rad = wrap_angle_rad(pair[1].yaw_rad - pair[0].yaw_rad);
                let mean_radps = 0.5 * (pair[0].yaw_rate_radps + pair[1].yaw_rate_radps);
                assert!((turned_rad / STEP_S - mean_radps).abs() < 0.05 + 0.05 * mean_radps.abs(), "{pair:?}");
                moved_m += step_m;
                top_mps = top_mps.max(pair[0].speed_mps);
                stands_s += if pair[0].speed_mps == 0.0 { STEP_S } else { 0.0 };
            }
            assert!((moved_m - drive.length_m()).abs() < 0.01 * drive.length_m(), "{moved_m} {}", drive.length_m());
            assert!(top_mps < fastest_mps && top_mps > 0.6 * fastest_mps, "{top_mps}");
            assert!(stands_s > 1.0, "{stands_s}");
        }
    }

    #[test]
    fn time_and_distance_agree() {
        for (drive, _) in drives() {
            for share in [0.0, 0.1, 0.37, 0.9] {
                let way_m = share * drive.length_m();
                let found = drive.pose_at(drive.time_at_distance_s(way_m)).position_m;
                assert!(distance_m(found, drive.path.at(way_m).position_m) < 1e-6);
            }
        }
    }

    #[test]
    fn impossible_settings_are_named() {
        assert_eq!(DriveSettings::default().check(), Ok(()));
        for (bad, key) in [
            (DriveSettings { laps: 0, ..DriveSettings::default() }, "laps"),
            (DriveSettings { lane_shift_m: f64::NAN, ..DriveSettings::default() }, "lane_shift_m"),
            (DriveSettings { speed_factor: 0.0, ..DriveSettings::default() }, "speed_factor"),
        ] {
            assert!(bad.check().is_err_and(|text| text.starts_with(key)), "{key}");
        }
    }

    #[test]
    fn the_same_seed_is_the_same_drive_and_another_is_not() {
        let world = World::town_block(1);
        let drive = |seed| Drive::new(&world, &DriveSettings { seed, ..DriveSettings::default() }).pose_at(33.3);
        assert_eq!(drive(5), drive(5));
        assert_ne!(drive(5), drive(6));
    }
}
