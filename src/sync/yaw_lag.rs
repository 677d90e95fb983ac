//! By how much one record of the vehicle's yaw comes after another.

use std::{collections::VecDeque, f64::consts::TAU};

use crate::types::wrap_angle_rad;

/// The camera's yaw is compared with the receiver's in pieces of this length.
pub const PIECE_S: f64 = 8.0;
/// Lags tried: from −1 s to 1 s.
pub const MAX_LAG_S: f64 = 1.0;
const LAG_STEP_S: f64 = 0.02;
const LAGS: usize = 101;
/// A piece shows a turn when the yaw strays this much from a straight line; a right-angled turn within it: 0.4 \[rad\].
const MIN_TURN_RMS_RAD: f64 = 0.06;
/// Fewer points of the camera's yaw in a piece say too little; more are thinned out.
const MIN_POINTS: usize = 20;
const MAX_POINTS: usize = 240;
/// Longer holes in the receiver's yaw are not interpolated over.
const MAX_HOLE_S: f64 = 0.35;
/// Pieces that are kept, and for how long.
const PIECES: usize = 16;
const PIECE_AGE_S: f64 = 1200.0;
/// The two yaws must agree: correlation, and how many radians of the camera's there are for one of the receiver's.
/// Things nearby make the camera see a little more or less than the turn.
const MIN_CORRELATION: f64 = 0.9;
const GAIN: std::ops::RangeInclusive<f64> = 0.6..=1.5;
/// Neighbouring residuals resemble each other, so that there are fewer of them than it seems: the factor on the
/// deviation, of which the tests show that it is not too small.
const RESIDUAL_FACTOR: f64 = 2.5;
/// No lag is known better than frames and headings are stamped.
const MIN_STD_S: f64 = 0.001;
/// A lag with a larger deviation is not worth more than none.
const MAX_STD_S: f64 = 0.06;
/// So many turns show by their spread how well each is seen. For fewer it is assumed: what is left of parallax shifts a
/// right-angled turn between houses by this much.
const SPREADING_TURNS: usize = 3;
const TURN_STD_S: f64 = 0.05;

/// Yaw at an instant \[s, rad\].
pub type YawPoint = (f64, f64);

/// A lag that was found.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct LagEstimate {
    /// The receiver's yaw is that which the camera saw this much earlier.
    pub lag_s: f64,
    /// One standard deviation.
    pub std_s: f64,
    /// Pieces with a turn that it comes from.
    pub turns: usize,
}

/// Sums over one piece at every lag; the yaws less their best straight lines.
#[derive(Debug, Clone)]
pub struct Piece {
    start_s: f64,
    points: usize,
    camera_squared: f64,
    receiver_squared: [f64; LAGS],
    product: [f64; LAGS],
}

/// A sliding set of pieces with turns.
#[derive(Debug, Clone, Default)]
pub struct YawLag {
    pieces: VecDeque<Piece>,
}

fn lag_s(index: usize) -> f64 {
    index as f64 * LAG_STEP_S - MAX_LAG_S
}

impl Piece {
    /// Compares the camera's yaw, of one piece and in order, with the receiver's, which must cover the piece and
    /// [`MAX_LAG_S`] on both sides. `None`: it does not, or the vehicle did not turn.
    pub fn compare(camera: &[YawPoint], receiver: &[YawPoint]) -> Option<Self> {
        let step = camera.len().div_ceil(MAX_POINTS).max(1);
        let camera: Vec<YawPoint> = camera.iter().step_by(step).copied().collect();
        if camera.len() < MIN_POINTS {
            return None;
        }
        let (first_s, last_s) = (camera.first()?.0, camera.last()?.0);
        let receiver = covering(receiver, first_s - MAX_LAG_S, last_s + MAX_LAG_S)?;
        let times: Vec<f64> = camera.iter().map(|point| point.0).collect();
        let line = Line::over(&times)?;

        let seen = line.remove(unwrapped(camera.iter().map(|point| point.1)));
        let mut piece = Self {
            start_s: first_s,
            points: camera.len(),
            camera_squared: seen.iter().map(|y| y * y).sum(),
            receiver_squared: [0.0; LAGS],
            product: [0.0; LAGS],
        };
        for index in 0..LAGS {
            let turned = line.remove(sampled(&receiver, times.iter().map(|t| t + lag_s(index))));
            piece.receiver_squared[index] = turned.iter().map(|x| x * x).sum();
            piece.product[index] = turned.iter().zip(&seen).map(|(x, y)| x * y).sum();
        }
        let turned_rms_rad = (piece.receiver_squared[LAGS / 2] / piece.points as f64).sqrt();
        (turned_rms_rad >= MIN_TURN_RMS_RAD).then_some(piece)
    }

    /// Whether the receiver's yaw in the piece from `start_s` strays from a straight line: how much \[rad\].
    pub fn turn_rms_rad(receiver: &[YawPoint]) -> Option<f64> {
        let times: Vec<f64> = receiver.iter().map(|point| point.0).collect();
        let rest = Line::over(&times)?.remove(unwrapped(receiver.iter().map(|point| point.1)));
        let rms_rad = (rest.iter().map(|x| x * x).sum::<f64>() / rest.len() as f64).sqrt();
        (rms_rad >= MIN_TURN_RMS_RAD).then_some(rms_rad)
    }
}

impl YawLag {
    /// Adds a piece; old ones go.
    pub fn push(&mut self, piece: Piece) {
        let oldest_s = piece.start_s - PIECE_AGE_S;
        self.pieces.retain(|old| old.start_s >= oldest_s);
        if self.pieces.len() == PIECES {
            self.pieces.pop_front();
        }
        self.pieces.push_back(piece);
    }

    /// The lag at which the yaws agree best. `None`: too few turns to tell, or the yaws do not agree.
    pub fn estimate(&self) -> Option<LagEstimate> {
        let pieces: Vec<&Piece> = self.pieces.iter().collect();
        let all = Best::of(&pieces)?;
        let correlation_squared = 1.0 - all.misfit / all.camera_squared;
        if correlation_squared < MIN_CORRELATION * MIN_CORRELATION || !GAIN.contains(&all.gain) {
            return None;
        }
        let std_s = all.std_s().max(spread_s(&pieces, &all)).max(MIN_STD_S);
        let turns = pieces.len();
        let unseen_s = if turns < SPREADING_TURNS { TURN_STD_S / (turns as f64).sqrt() } else { 0.0 };
        (std_s <= MAX_STD_S).then_some(LagEstimate { lag_s: all.lag_s, std_s: libm::hypot(std_s, unseen_s), turns })
    }
}

/// The lag of least misfit Σ (y − g x)² over all points of some pieces, with g the best gain.
struct Best {
    lag_s: f64,
    misfit: f64,
    /// Second derivative of the misfit \[rad²/s²\].
    curvature: f64,
    gain: f64,
    camera_squared: f64,
    /// Points less what was fitted to them: two of the line of each piece, gain and lag.
    freedom: f64,
}

impl Best {
    fn of(pieces: &[&Piece]) -> Option<Self> {
        let camera_squared: f64 = pieces.iter().map(|piece| piece.camera_squared).sum();
        let gain_at = |index: usize| {
            let product: f64 = pieces.iter().map(|piece| piece.product[index]).sum();
            let squared: f64 = pieces.iter().map(|piece| piece.receiver_squared[index]).sum();
            (product / squared, camera_squared - product.max(0.0).powi(2) / squared)
        };
        let misfit = |index: usize| gain_at(index).1;
        let lowest = (0..LAGS).min_by(|&a, &b| misfit(a).total_cmp(&misfit(b)))?;
        if lowest == 0 || lowest == LAGS - 1 {
            return None;
        }
        // A parabola through the lowest three.
        let [left, center, right] = [lowest - 1, lowest, lowest + 1].map(misfit);
        let bend = left - 2.0 * center + right;
        let beside = (left - right) / (2.0 * bend);
        if !(bend > 0.0 && beside.is_finite()) {
            return None;
        }
        let points: usize = pieces.iter().map(|piece| piece.points).sum();
        Some(Self {
            lag_s: lag_s(lowest) + beside * LAG_STEP_S,
            misfit: (center - bend * beside * beside / 2.0).max(0.0),
            curvature: bend / (LAG_STEP_S * LAG_STEP_S),
            gain: gain_at(lowest).0,
            camera_squared,
            freedom: points as f64 - 2.0 * pieces.len() as f64 - 2.0,
        })
    }

    /// Of a least-squares fit: var = 2 σ² / curvature, σ² = misfit / degrees of freedom.
    fn std_s(&self) -> f64 {
        RESIDUAL_FACTOR * (2.0 * self.misfit / self.freedom.max(1.0) / self.curvature).sqrt()
    }
}

/// One standard deviation of the mean lag, from how the lags of single pieces spread; 0 for fewer than three.
fn spread_s(pieces: &[&Piece], all: &Best) -> f64 {
    let each: Vec<Best> = pieces.iter().filter_map(|piece| Best::of(&[piece])).collect();
    if each.len() < 3 {
        return 0.0;
    }
    let weight: f64 = each.iter().map(|piece| piece.curvature).sum();
    let squares: f64 = each.iter().map(|piece| piece.curvature * (piece.lag_s - all.lag_s).powi(2)).sum();
    (squares / weight / (each.len() - 1) as f64).sqrt()
}

/// A straight line over fixed times, to be taken off values at these times.
struct Line<'a> {
    times: &'a [f64],
    mean_s: f64,
    squared: f64,
}

impl<'a> Line<'a> {
    fn over(times: &'a [f64]) -> Option<Self> {
        let mean_s = times.iter().sum::<f64>() / times.len() as f64;
        let squared: f64 = times.iter().map(|t| (t - mean_s).powi(2)).sum();
        (squared > 0.0).then_some(Self { times, mean_s, squared })
    }

    fn remove(&self, mut values: Vec<f64>) -> Vec<f64> {
        let mean = values.iter().sum::<f64>() / values.len() as f64;
        let product: f64 = self.times.iter().zip(&values).map(|(t, y)| (t - self.mean_s) * (y - mean)).sum();
        let slope = product / self.squared;
        self.times.iter().zip(&mut values).for_each(|(t, y)| *y -= mean + slope * (t - self.mean_s));
        values
    }
}

/// Angles without jumps of a whole turn.
fn unwrapped(angles: impl Iterator<Item = f64>) -> Vec<f64> {
    let mut last: Option<f64> = None;
    let follow = |angle: f64| {
        let continued = last.map_or(angle, |last| last + wrap_angle_rad(angle - last));
        last = Some(continued);
        continued
    };
    angles.map(follow).collect()
}

/// The part of a yaw record that covers the span, unwrapped; `None` if it does not or has holes.
fn covering(yaw: &[YawPoint], from_s: f64, to_s: f64) -> Option<Vec<YawPoint>> {
    let first = yaw.iter().rposition(|point| point.0 <= from_s)?;
    let last = yaw.iter().position(|point| point.0 >= to_s)?;
    let part = yaw.get(first..=last)?;
    let sound = part.windows(2).all(|pair| {
        let step_s = pair[1].0 - pair[0].0;
        (0.0..=MAX_HOLE_S).contains(&step_s) && wrap_angle_rad(pair[1].1 - pair[0].1).abs() < TAU / 4.0
    });
    let angles = unwrapped(part.iter().map(|point| point.1));
    sound.then(|| part.iter().zip(angles).map(|(point, angle)| (point.0, angle)).collect())
}

/// A record at rising times within it, interpolated linearly.
fn sampled(record: &[YawPoint], times: impl Iterator<Item = f64>) -> Vec<f64> {
    let mut next = 1;
    let at = |t: f64| {
        while next + 1 < record.len() && record[next].0 < t {
            next += 1;
        }
        let ((t0, y0), (t1, y1)) = (record[next - 1], record[next]);
        if t1 > t0 { y0 + (y1 - y0) * ((t - t0) / (t1 - t0)) } else { y1 }
    };
    times.map(at).collect()
}

#[cfg(test)]
mod tests {
    use super::*;

    fn yaw_rad(time_s: f64) -> f64 {
        // Right-angled turns of 4 s, one in 8 s, to the left and to the right.
        let turn = (time_s / PIECE_S).floor();
        let within = ((time_s - turn * PIECE_S - 2.0) / 4.0).clamp(0.0, 1.0);
        let size_rad = if turn.rem_euclid(2.0) == 0.0 { 1.57 } else { -1.57 };
        let before_rad = if turn.rem_euclid(2.0) == 0.0 { 0.0 } else { 1.57 };
        3.0 + before_rad + size_rad * (within - (TAU * within).sin() / TAU)
    }

    fn record(from_s: f64, to_s: f64, hz: f64, delay_s: f64) -> Vec<YawPoint> {
        let ticks = (from_s * hz) as i64..=(to_s * hz) as i64;
        ticks.map(|i| i as f64 / hz).map(|t| (t, wrap_angle_rad(yaw_rad(t - delay_s)))).collect()
    }

    fn lag(pieces: usize, delay_s: f64, gain: f64) -> Option<LagEstimate> {
        let mut lag = YawLag::default();
        let receiver = record(0.0, 200.0, 100.0, delay_s);
        for piece in 0..pieces {
            let start_s = 8.0 * (piece + 1) as f64;
            let mut camera = record(start_s, start_s + PIECE_S, 15.0, 0.0);
            let angles = unwrapped(camera.iter().map(|point| point.1));
            camera.iter_mut().zip(angles).for_each(|(point, angle)| point.1 = gain * angle);
            lag.push(Piece::compare(&camera, &receiver)?);
        }
        lag.estimate()
    }

    #[test]
    fn the_lag_is_found_between_its_steps() {
        for delay_s in [-0.73, -0.2, 0.0, 0.007, 0.31, 0.333, 0.9] {
            for (pieces, gain) in [(1, 1.0), (6, 0.9), (6, 1.2)] {
                let found = lag(pieces, delay_s, gain).expect("turns enough");
                assert!((found.lag_s - delay_s).abs() < 1e-3, "{found:?}, truth {delay_s}");
                let unseen_s = if pieces < SPREADING_TURNS { TURN_STD_S } else { 0.0 };
                assert!(found.std_s < 0.005 + unseen_s && found.turns == pieces);
            }
        }
    }

    #[test]
    fn no_lag_is_found_where_the_yaws_disagree() {
        assert_eq!(lag(0, 0.1, 1.0), None, "no turns");
        assert_eq!(lag(4, 0.1, -1.0), None, "the camera turns the other way");
        assert_eq!(lag(4, 0.1, 3.0), None, "three times as much");
        assert_eq!(lag(4, 1.5, 1.0), None, "too far apart to be tried");
    }

    #[test]
    fn a_piece_needs_a_turn_and_a_yaw_without_holes() {
        let camera = record(8.0, 16.0, 15.0, 0.0);
        assert!(Piece::compare(&camera, &record(0.0, 30.0, 100.0, 0.0)).is_some());
        assert!(Piece::compare(&camera, &record(8.0, 30.0, 100.0, 0.0)).is_none(), "does not begin early enough");
        assert!(Piece::compare(&camera, &record(0.0, 30.0, 2.0, 0.0)).is_none(), "too far between");
        let straight: Vec<YawPoint> = (0..3000).map(|i| (f64::from(i) / 100.0, 1.0)).collect();
        assert!(Piece::compare(&camera, &straight).is_none(), "the vehicle went straight on");
        assert!(Piece::compare(&camera[..10], &record(0.0, 30.0, 100.0, 0.0)).is_none(), "too few frames");
    }
}
