//! Points of the scene, followed from frame to frame through the panoramas of a recording.

use std::f64::consts::TAU;
use std::sync::Arc;

use rayon::prelude::*;

use crate::panorama::{WIDE_COLUMNS, WIDE_ROWS};
use crate::types::AzimuthSense;

/// Reductions of the panorama by 2, the panorama itself included.
const LEVELS: usize = 3;
/// Points followed at a time, and how far apart new ones must be \[px\].
const POINTS: usize = 150;
const APART_PX: f32 = 8.0;
/// Points that come nearer to each other than this \[px\] are one.
const LEAST_APART_PX: f32 = 2.0;
/// A point is a square of pixels, this many to either side of the middle.
const HALF_PX: usize = 4;
const SIDE_PX: usize = 2 * HALF_PX + 1;
/// Points are looked for in these rows: further up there is sky, further down the vehicle.
const ROWS: std::ops::Range<usize> = 8..WIDE_ROWS * 7 / 8 - HALF_PX;
/// The weaker gradient of a point must be this share of that of the best one.
const LEAST_QUALITY: f32 = 0.01;
const MOST_STEPS: usize = 10;
const LEAST_STEP_PX: f32 = 0.02;
/// A square that is so much fainter than it was is another one.
const LEAST_GAIN: f32 = 0.3;
/// A point that, followed back, ends further than this from where it began is lost \[px\].
const MOST_MISS_PX: f32 = 0.7;
/// And one whose square correlates less than this with what it was in the frame before; one that correlates more than that
/// is looked for no longer.
const LEAST_CORRELATION: f32 = 0.8;
const SURE_CORRELATION: f32 = 0.95;
/// Where a point is looked for, from where its last step would take it: a step moves far ones little, and near ones further
/// than [`step_by_step`] gets by itself.
const GUESSES_PX: [f32; 7] = [0.0, -6.0, 6.0, -12.0, 12.0, -20.0, 20.0];
/// The same in another pass, from where bearings say it is: that is off by a share of the error across the street.
const GUESSES_ACROSS_PX: [f32; 3] = [0.0, -5.0, 5.0];
/// What is nearer or further away in another pass is larger or smaller there, which is allowed for so far: pixels of the one
/// frame to a pixel of the other.
const SPACINGS_PX: std::ops::RangeInclusive<f64> = 0.5..=2.0;

/// A point of the scene as a frame saw it.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct Sighting {
    /// Number of the point.
    pub point: usize,
    /// From ahead, counter-clockwise, but for an angle that is the same for all of a camera.
    pub azimuth_rad: f64,
    /// Row of the panorama \[px\].
    pub height_px: f32,
}

/// Follows points (Lucas & Kanade 1981, over an image pyramid, Bouguet 2000) whose two gradients are strong (Shi & Tomasi
/// 1994), there and back again (Kalal, Mikolajczyk & Matas 2010).
pub struct PointFollower {
    azimuth: AzimuthSense,
    before: Option<Seen>,
    next_point: usize,
}

/// A frame and the points in it.
struct Seen {
    pyramid: Vec<Plane>,
    yaw_rad: f64,
    points: Vec<Point>,
}

#[derive(Debug, Clone, Copy)]
struct Point {
    number: usize,
    at: [f32; 2],
    /// How far the last step of the vehicle, less its turn, moved it along the row \[px\].
    shift_px: f32,
}

impl PointFollower {
    pub fn new(azimuth: AzimuthSense) -> Self {
        Self { azimuth, before: None, next_point: 0 }
    }

    /// The points of the next frame of the recording, `wide` of its panorama: those that were followed, and new ones.
    pub fn take(&mut self, wide: &[f32], yaw_rad: f64) -> Vec<Sighting> {
        let pyramid = pyramid(wide);
        let mut points = Vec::with_capacity(POINTS);
        if let Some(before) = &self.before {
            // What a turn of the vehicle alone does to the columns.
            let turned = columns_px(before.yaw_rad - yaw_rad, self.azimuth);
            let followed: Vec<Option<Point>> =
                before.points.par_iter().map(|point| point.followed(&before.pyramid, &pyramid, turned)).collect();
            for point in followed.into_iter().flatten() {
                // Two that look alike may come to be one, which would count twice.
                if points.iter().all(|other: &Point| apart_px(other.at, point.at) >= LEAST_APART_PX) {
                    points.push(point);
                }
            }
        }
        self.add_new(&pyramid[0], &mut points);
        let sighting = |point: &Point| Sighting {
            point: point.number,
            azimuth_rad: azimuth_rad(point.at[0], self.azimuth),
            height_px: point.at[1],
        };
        let sightings = points.iter().map(sighting).collect();
        self.before = Some(Seen { pyramid, yaw_rad, points });
        sightings
    }

    /// Fills up with the strongest points that are far enough from all others.
    fn add_new(&mut self, plane: &Plane, points: &mut Vec<Point>) {
        let strengths = plane.weaker_gradients();
        let best = strengths.iter().copied().fold(0.0, f32::max);
        let mut order: Vec<usize> = (0..strengths.len()).filter(|&i| strengths[i] > LEAST_QUALITY * best).collect();
        order.sort_unstable_by(|&a, &b| strengths[b].total_cmp(&strengths[a]).then(a.cmp(&b)));
        for i in order {
            if points.len() >= POINTS {
                return;
            }
            let at = [(i % plane.columns) as f32, (i / plane.columns) as f32];
            if points.iter().all(|point| apart_px(point.at, at) >= APART_PX) {
                points.push(Point { number: self.next_point, at, shift_px: 0.0 });
                self.next_point += 1;
            }
        }
    }
}

impl Point {
    /// In the next frame, where a turn alone would have moved it by so many columns. Of what is found from several guesses,
    /// what looks most like it.
    fn followed(&self, before: &[Plane], now: &[Plane], turned_px: f32) -> Option<Self> {
        let guesses_px = GUESSES_PX.map(|further_px| turned_px + self.shift_px + further_px);
        let at = found(before, now, self.at, &guesses_px, 1.0)?;
        Some(Self { at, shift_px: shorter_way_px(at[0] - self.at[0] - turned_px), ..*self })
    }
}

/// A frame's wide panorama, kept so that points of other frames can be looked for in it.
#[derive(Debug, Clone)]
pub struct KeptImage {
    /// Whole gray values, which take a quarter of the memory.
    wide: Arc<[u8]>,
    azimuth: AzimuthSense,
}

/// A point that one frame sees and that is looked for in another.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct Wanted {
    /// Where the one sees it.
    pub azimuth_rad: f64,
    pub height_px: f32,
    /// Where the other is thought to, and how many times as far away it is from there.
    pub thought_rad: f64,
    pub farther: f64,
}

impl KeptImage {
    pub fn new(wide: &[f32], azimuth: AzimuthSense) -> Self {
        Self { wide: wide.iter().map(|value| value.round() as u8).collect(), azimuth }
    }

    /// The azimuths at which this frame sees the points `wanted` of `other`; `None` for those that it does not show.
    pub fn find(&self, other: &Self, wanted: &[Wanted]) -> Vec<Option<f64>> {
        let (before, now) = (other.levels(), self.levels());
        let find = |wanted: &Wanted| {
            let here = [columns_px(wanted.azimuth_rad, other.azimuth), wanted.height_px];
            let thought_px = shorter_way_px(columns_px(wanted.thought_rad, self.azimuth) - here[0]);
            let guesses_px = GUESSES_ACROSS_PX.map(|further_px| thought_px + further_px);
            let spacing_px = wanted.farther.clamp(*SPACINGS_PX.start(), *SPACINGS_PX.end()) as f32;
            found(&before, &now, here, &guesses_px, spacing_px).map(|at| azimuth_rad(at[0], self.azimuth))
        };
        wanted.iter().map(find).collect()
    }

    fn levels(&self) -> Vec<Plane> {
        pyramid(&self.wide.iter().map(|&value| f32::from(value)).collect::<Vec<f32>>())
    }
}

fn azimuth_rad(columns_px: f32, azimuth: AzimuthSense) -> f64 {
    let angle_rad = f64::from(columns_px) / WIDE_COLUMNS as f64 * TAU;
    match azimuth {
        AzimuthSense::Ccw => angle_rad,
        AzimuthSense::Cw => -angle_rad,
    }
}

fn columns_px(azimuth_rad: f64, azimuth: AzimuthSense) -> f32 {
    let columns_px = azimuth_rad / TAU * WIDE_COLUMNS as f64;
    match azimuth {
        AzimuthSense::Ccw => columns_px as f32,
        AzimuthSense::Cw => -columns_px as f32,
    }
}

/// Where in `now` is what is at `here` in `before`, looked for so many columns further on. Of what is found there and back
/// again, what looks most like it. A pixel of `now` is `spacing_px` of `before`.
fn found(before: &[Plane], now: &[Plane], here: [f32; 2], guesses_px: &[f32], spacing_px: f32) -> Option<[f32; 2]> {
    let mut best: Option<(f32, [f32; 2])> = None;
    for &guess_px in guesses_px {
        let Some(at) = follow(before, now, here, [guess_px, 0.0], spacing_px) else { continue };
        let back = follow(now, before, at, [-guess_px, 0.0], 1.0 / spacing_px);
        if back.is_none_or(|back| apart_px(back, here) > MOST_MISS_PX) {
            continue;
        }
        let likeness = correlation(&before[0].square(here, spacing_px), &now[0].square(at, 1.0));
        if likeness > best.map_or(LEAST_CORRELATION, |(best, _)| best) {
            best = Some((likeness, at));
        }
        if likeness > SURE_CORRELATION {
            break;
        }
    }
    best.map(|(_, at)| at)
}

/// One level of a pyramid. Columns wrap round, rows end.
struct Plane {
    columns: usize,
    rows: usize,
    values: Vec<f32>,
}

fn pyramid(wide: &[f32]) -> Vec<Plane> {
    assert_eq!(wide.len(), WIDE_ROWS * WIDE_COLUMNS, "the wide panorama");
    let mut levels = vec![Plane { columns: WIDE_COLUMNS, rows: WIDE_ROWS, values: wide.to_vec() }];
    for _ in 1..LEVELS {
        levels.extend(levels.last().map(Plane::halved));
    }
    levels
}

impl Plane {
    fn halved(&self) -> Self {
        let (columns, rows) = (self.columns / 2, self.rows / 2);
        let mean = |i: usize| {
            let first = 2 * (i / columns) * self.columns + 2 * (i % columns);
            let [a, b] = [first, first + self.columns].map(|at| self.values[at] + self.values[at + 1]);
            0.25 * (a + b)
        };
        Self { columns, rows, values: (0..columns * rows).map(mean).collect() }
    }

    /// Bilinearly.
    fn at(&self, [x, y]: [f32; 2]) -> f32 {
        let x = x.rem_euclid(self.columns as f32);
        let y = y.clamp(0.0, (self.rows - 1) as f32);
        let (left, top) = (x as usize % self.columns, (y as usize).min(self.rows - 2));
        let (right, below) = ((left + 1) % self.columns, top + 1);
        let (dx, dy) = (x - x.floor(), y - top as f32);
        let row = |row: usize| {
            let row = &self.values[row * self.columns..(row + 1) * self.columns];
            row[left] + dx * (row[right] - row[left])
        };
        let upper = row(top);
        upper + dy * (row(below) - upper)
    }

    /// The square of pixels around a place, `spacing_px` from each to the next.
    fn square(&self, [x, y]: [f32; 2], spacing_px: f32) -> [f32; SIDE_PX * SIDE_PX] {
        std::array::from_fn(|i| {
            let [dx, dy] = [i % SIDE_PX, i / SIDE_PX].map(|d| spacing_px * (d as f32 - HALF_PX as f32));
            self.at([x + dx, y + dy])
        })
    }

    /// The smaller eigenvalue of the gradients' second moments over the square around every pixel; 0 outside [`ROWS`] and
    /// where a neighbour's is larger.
    fn weaker_gradients(&self) -> Vec<f32> {
        let (columns, rows) = (self.columns, self.rows);
        let value = |row: usize, column: usize| self.values[row * columns + column % columns];
        // xx, xy, yy, summed along the rows and then down the columns.
        let mut moments = vec![[0.0_f32; 3]; columns * rows];
        for row in 1..rows - 1 {
            for column in 0..columns {
                let x = 0.5 * (value(row, column + 1) - value(row, column + columns - 1));
                let y = 0.5 * (value(row + 1, column) - value(row - 1, column));
                moments[row * columns + column] = [x * x, x * y, y * y];
            }
        }
        let summed = |of: &dyn Fn(usize) -> [f32; 3]| {
            (0..SIDE_PX).map(of).fold([0.0; 3], |sum, m| std::array::from_fn(|k| sum[k] + m[k]))
        };
        let across: Vec<[f32; 3]> = (0..columns * rows)
            .map(|i| {
                let (row, column) = (i / columns, i % columns);
                summed(&|k| moments[row * columns + (column + columns + k - HALF_PX) % columns])
            })
            .collect();
        let mut weaker = vec![0.0; columns * rows];
        for row in ROWS {
            for column in 0..columns {
                let [xx, xy, yy] = summed(&|k| across[(row + k - HALF_PX) * columns + column]);
                weaker[row * columns + column] = 0.5 * (xx + yy - ((xx - yy).powi(2) + 4.0 * xy * xy).sqrt());
            }
        }
        let is_summit = |&i: &usize| {
            let (row, column) = (i / columns, i % columns);
            let neighbours = (row.saturating_sub(1)..(row + 2).min(rows))
                .flat_map(|row| [columns - 1, 0, 1].map(|by| row * columns + (column + by) % columns));
            neighbours.into_iter().all(|other| weaker[other] <= weaker[i])
        };
        let summits: Vec<usize> = (0..columns * rows).filter(is_summit).collect();
        let mut strengths = vec![0.0; columns * rows];
        summits.into_iter().for_each(|i| strengths[i] = weaker[i]);
        strengths
    }
}

/// Where the square of `from` around `at`, `spacing_px` of whose pixels are one of `to`, is there, `guess` further on to
/// begin with; `None` where it is not found.
fn follow(from: &[Plane], to: &[Plane], at: [f32; 2], guess: [f32; 2], spacing_px: f32) -> Option<[f32; 2]> {
    let scale = |level: usize| 0.5_f32.powi(level as i32);
    let mut shift = guess;
    for level in (0..LEVELS).rev() {
        // The centre of pixel 0 lies between those of the two it was made of.
        let here = at.map(|at| (at + 0.5) * scale(level) - 0.5);
        let guess = shift.map(|s| s * scale(level));
        shift = step_by_step(&from[level], &to[level], here, guess, spacing_px)?.map(|s| s / scale(level));
    }
    let there = [(at[0] + shift[0]).rem_euclid(WIDE_COLUMNS as f32), at[1] + shift[1]];
    (ROWS.start as f32..ROWS.end as f32).contains(&there[1]).then_some(there)
}

/// Gauss-Newton on Σ (to(x + s)/g − from(x))² over the square, both less their means, with the gradient of `from` (Baker &
/// Matthews 2004) and the gain g that fits best: brightness may have changed.
fn step_by_step(from: &Plane, to: &Plane, at: [f32; 2], mut shift: [f32; 2], spacing_px: f32) -> Option<[f32; 2]> {
    let mut square = from.square(at, spacing_px);
    center(&mut square);
    let half_px = 0.5 * spacing_px;
    let beside = |by: [f32; 2]| from.square([at[0] + by[0], at[1] + by[1]], spacing_px);
    let (right, left) = (beside([half_px, 0.0]), beside([-half_px, 0.0]));
    let (below, above) = (beside([0.0, half_px]), beside([0.0, -half_px]));
    let mut x: [f32; SIDE_PX * SIDE_PX] = std::array::from_fn(|i| right[i] - left[i]);
    let mut y: [f32; SIDE_PX * SIDE_PX] = std::array::from_fn(|i| below[i] - above[i]);
    center(&mut x);
    center(&mut y);
    let (xx, xy, yy) = (dot(&x, &x), dot(&x, &y), dot(&y, &y));
    let determinant = xx * yy - xy * xy;
    if determinant <= f32::EPSILON * (xx + yy).powi(2) {
        return None;
    }
    for _ in 0..MOST_STEPS {
        let mut there = to.square([at[0] + shift[0], at[1] + shift[1]], 1.0);
        center(&mut there);
        let gain = dot(&there, &square) / dot(&square, &square);
        if gain < LEAST_GAIN {
            return None;
        }
        let rest: [f32; SIDE_PX * SIDE_PX] = std::array::from_fn(|i| there[i] / gain - square[i]);
        let (bx, by) = (dot(&x, &rest), dot(&y, &rest));
        let step = [(yy * bx - xy * by) / determinant, (xx * by - xy * bx) / determinant];
        shift = [shift[0] - step[0], shift[1] - step[1]];
        if step[0].hypot(step[1]) < LEAST_STEP_PX {
            break;
        }
    }
    shift.iter().all(|s| s.is_finite()).then_some(shift)
}

/// Of two squares.
fn correlation(one: &[f32; SIDE_PX * SIDE_PX], other: &[f32; SIDE_PX * SIDE_PX]) -> f32 {
    let (mut a, mut b) = (*one, *other);
    center(&mut a);
    center(&mut b);
    dot(&a, &b) / (dot(&a, &a) * dot(&b, &b)).sqrt().max(f32::MIN_POSITIVE)
}

fn center(values: &mut [f32; SIDE_PX * SIDE_PX]) {
    let mean = values.iter().sum::<f32>() / values.len() as f32;
    values.iter_mut().for_each(|value| *value -= mean);
}

fn dot(a: &[f32], b: &[f32]) -> f32 {
    a.iter().zip(b).map(|(a, b)| a * b).sum()
}

fn apart_px(a: [f32; 2], b: [f32; 2]) -> f32 {
    shorter_way_px(a[0] - b[0]).hypot(a[1] - b[1])
}

/// Of the two ways round.
fn shorter_way_px(columns: f32) -> f32 {
    let half = 0.5 * WIDE_COLUMNS as f32;
    (columns + half).rem_euclid(WIDE_COLUMNS as f32) - half
}

#[cfg(test)]
mod tests {
    use rand::{Rng, SeedableRng};
    use rand_chacha::ChaCha8Rng;

    use super::*;
    use crate::types::wrap_angle_rad;

    /// Blobs all around, `shifted` columns further on, as bright as `gain` makes them.
    fn scene(shifted: f32, gain: f32) -> Vec<f32> {
        let mut random = ChaCha8Rng::seed_from_u64(3);
        let mut share = || random.random::<f32>();
        let mut blob = || [512.0 * share(), 8.0 + 100.0 * share(), 1.5 + 2.0 * share(), 160.0 * share() - 80.0];
        let blobs: Vec<[f32; 4]> = (0..500).map(|_| blob()).collect();
        let value = |i: usize| {
            let at = [(i % WIDE_COLUMNS) as f32 - shifted, (i / WIDE_COLUMNS) as f32];
            let of_blob = |&[x, y, size, height]: &[f32; 4]| {
                let apart = apart_px([at[0].rem_euclid(512.0), at[1]], [x, y]);
                height * (-0.5 * (apart / size).powi(2)).exp()
            };
            gain * (120.0 + blobs.iter().map(of_blob).sum::<f32>())
        };
        (0..WIDE_ROWS * WIDE_COLUMNS).map(value).collect()
    }

    #[test]
    fn points_are_followed_round_the_seam_and_in_other_light() {
        for azimuth in [AzimuthSense::Ccw, AzimuthSense::Cw] {
            let mut follower = PointFollower::new(azimuth);
            let first = follower.take(&scene(0.0, 1.0), 0.3);
            // Seven columns more than the vehicle turned.
            let (turned, more) = (100.0, 7.3);
            let sense = if azimuth == AzimuthSense::Ccw { 1.0 } else { -1.0 };
            let yaw_rad = 0.3 - sense * turned / 512.0 * TAU;
            let second = follower.take(&scene((turned + more) as f32, 0.7), yaw_rad);
            let missed_px: Vec<f64> = second
                .iter()
                .filter_map(|there| Some((first.iter().find(|here| here.point == there.point)?, there)))
                .map(|(here, there)| wrap_angle_rad(there.azimuth_rad - here.azimuth_rad) * sense / TAU * 512.0)
                .map(|moved| (moved - turned - more).abs())
                .collect();
            assert!(first.len() == POINTS && missed_px.len() > POINTS / 2, "{} of {}", missed_px.len(), first.len());
            // One blob looks much like another.
            let well = missed_px.iter().filter(|&&missed_px| missed_px < 0.1).count();
            assert!(well > missed_px.len() * 9 / 10, "{well} of {}", missed_px.len());
        }
    }

    #[test]
    fn another_scene_shares_no_points_and_a_blank_one_has_none() {
        let mut follower = PointFollower::new(AzimuthSense::Ccw);
        let first = follower.take(&scene(0.0, 1.0), 0.0);
        let mut other = scene(0.0, 1.0);
        other.reverse();
        let second = follower.take(&other, 0.0);
        let kept = second.iter().filter(|there| first.iter().any(|here| here.point == there.point)).count();
        assert!(kept < first.len() / 10, "{kept} of {}", first.len());
        assert!(follower.take(&vec![80.0; WIDE_ROWS * WIDE_COLUMNS], 0.0).is_empty());
    }

    #[test]
    fn what_another_pass_sees_from_nearer_by_is_found_where_it_is_thought_to_be() {
        // Five blobs about a place, so many times as large.
        let image = |middle_px: f32, larger: f32| {
            let blobs =
                [[-3.0, -2.0, 70.0], [3.0, 1.0, 60.0], [0.0, 3.0, -60.0], [3.0, -4.0, -50.0], [-4.0, 3.0, 40.0]];
            let value = |i: usize| {
                let at =
                    [(i % WIDE_COLUMNS) as f32 - middle_px, (i / WIDE_COLUMNS) as f32 - 60.0].map(|px| px / larger);
                let of_blob =
                    |&[x, y, height]: &[f32; 3]| height * (-((at[0] - x).powi(2) + (at[1] - y).powi(2)) / 6.0).exp();
                120.0 + blobs.iter().map(of_blob).sum::<f32>()
            };
            let wide: Vec<f32> = (0..WIDE_ROWS * WIDE_COLUMNS).map(value).collect();
            wide
        };
        for azimuth in [AzimuthSense::Ccw, AzimuthSense::Cw] {
            let [there, here] = [image(100.0, 1.0), image(400.0, 1.6)].map(|wide| KeptImage::new(&wide, azimuth));
            let wanted = Wanted {
                azimuth_rad: azimuth_rad(100.0, azimuth),
                height_px: 60.0,
                thought_rad: azimuth_rad(394.0, azimuth),
                farther: 1.0 / 1.6,
            };
            let elsewhere = Wanted { thought_rad: azimuth_rad(250.0, azimuth), ..wanted };
            let as_large = Wanted { farther: 1.0, ..wanted };
            let found = here.find(&there, &[wanted, elsewhere, as_large]);
            let off_px = |rad: Option<f64>| Some(shorter_way_px(columns_px(rad?, azimuth) - 400.0).abs());
            assert!(off_px(found[0]).is_some_and(|off_px| off_px < 0.2), "{found:?}");
            assert!(off_px(found[2]).is_none_or(|off_px| off_px > 0.3), "{found:?}");
            assert_eq!(found[1], None);
        }
    }

    #[test]
    fn two_points_that_come_to_be_one_count_once() {
        let blob = |at: &[f32]| -> Vec<f32> {
            let value = |i: usize| {
                let [x, y] = [(i % WIDE_COLUMNS) as f32, (i / WIDE_COLUMNS) as f32];
                let height = |&middle: &f32| 90.0 * (-((x - middle).powi(2) + (y - 60.0).powi(2)) / 18.0).exp();
                80.0 + at.iter().map(height).sum::<f32>()
            };
            (0..WIDE_ROWS * WIDE_COLUMNS).map(value).collect()
        };
        let mut follower = PointFollower::new(AzimuthSense::Ccw);
        assert_eq!(follower.take(&blob(&[100.0, 112.0]), 0.0).len(), 2);
        assert_eq!(follower.take(&blob(&[106.0]), 0.0).len(), 1);
    }
}
