//! What a world is made of: blocks, upright pictures and painted planes.

use super::texture::{Color, Texture};

/// A box with vertical sides, from `bottom_m` to `top_m`.
#[derive(Debug, Clone, Copy)]
pub(super) struct Block {
    pub center_m: [f32; 2],
    /// Half of its extent along its own x and y axis.
    pub half_m: [f32; 2],
    /// Cosine and sine of the angle from east to its x axis.
    pub direction: [f32; 2],
    pub bottom_m: f32,
    pub top_m: f32,
    /// Indices of the textures of the sides facing +x, +y, −x, −y.
    pub sides: [u16; 4],
    /// Seen from above or below.
    pub lid: Color,
}

impl Block {
    /// Along the axes of the world.
    pub fn upright(center_m: [f32; 2], half_m: [f32; 2], heights_m: [f32; 2], sides: [u16; 4], lid: Color) -> Self {
        let [bottom_m, top_m] = heights_m;
        Self { center_m, half_m, direction: [1.0, 0.0], bottom_m, top_m, sides, lid }
    }

    /// World → the block's own axes, for a direction.
    #[inline(always)]
    pub fn turned(&self, [x, y]: [f32; 2]) -> [f32; 2] {
        let [cos, sin] = self.direction;
        [cos * x + sin * y, cos * y - sin * x]
    }

    /// World → the block's own axes, for a place.
    #[inline(always)]
    pub fn local(&self, [x, y]: [f32; 2]) -> [f32; 2] {
        self.turned([x - self.center_m[0], y - self.center_m[1]])
    }

    pub fn corners_m(&self) -> [[f32; 2]; 4] {
        let ([cos, sin], [half_x, half_y]) = (self.direction, self.half_m);
        [[half_x, half_y], [-half_x, half_y], [-half_x, -half_y], [half_x, -half_y]]
            .map(|[x, y]| [self.center_m[0] + cos * x - sin * y, self.center_m[1] + sin * x + cos * y])
    }

    /// Outward normal of a side.
    pub fn normal(&self, side: usize) -> [f32; 2] {
        let [cos, sin] = self.direction;
        [[cos, sin], [-sin, cos], [-cos, -sin], [sin, -cos]][side]
    }

    /// Where the ray from `origin` (in the block's own axes) enters and leaves, as multiples of the direction whose
    /// inverse components are given, and the side it enters by. `None`: it misses, or begins inside.
    #[inline(always)]
    pub fn crossing(&self, origin: [f32; 2], inverse: [f32; 2]) -> Option<Crossing> {
        let slab = |axis: usize| {
            let reach = self.half_m[axis] * inverse[axis].abs();
            let middle = -origin[axis] * inverse[axis];
            (middle - reach, middle + reach)
        };
        let ((near_x, far_x), (near_y, far_y)) = (slab(0), slab(1));
        let (entry, exit) = (near_x.max(near_y), far_x.min(far_y));
        if entry >= exit || entry <= 0.0 {
            return None;
        }
        let side = if near_x > near_y {
            if inverse[0] < 0.0 { 0 } else { 2 }
        } else if inverse[1] < 0.0 {
            1
        } else {
            3
        };
        Some(Crossing { entry, exit, side })
    }

    /// How far along a side a place on it lies, from the left as seen from outside.
    #[inline(always)]
    pub fn along_side_m(&self, side: usize, [x, y]: [f32; 2]) -> f32 {
        match side {
            0 => y + self.half_m[1],
            1 => self.half_m[0] - x,
            2 => self.half_m[1] - y,
            _ => x + self.half_m[0],
        }
    }
}

#[derive(Debug, Clone, Copy, PartialEq)]
pub(super) struct Crossing {
    pub entry: f32,
    pub exit: f32,
    pub side: usize,
}

/// A picture that always faces the camera: a tree, a pole, a person.
#[derive(Debug, Clone, Copy)]
pub(super) struct Upright {
    pub center_m: [f32; 2],
    pub half_width_m: f32,
    pub top_m: f32,
    pub texture: u16,
}

/// A horizontal picture: ground or ceiling. Texture columns run along x, rows along y.
#[derive(Debug, Clone)]
pub(super) struct Plane {
    pub height_m: f32,
    /// The corner of the first texel.
    pub corner_m: [f32; 2],
    pub texture: Texture,
}

impl Plane {
    /// `color(x_m, y_m)` of every texel, not yet filtered.
    pub fn painted(
        height_m: f32,
        corner_m: [f32; 2],
        size_m: [f32; 2],
        texels_per_m: f32,
        color: impl Fn(f32, f32) -> Color,
    ) -> Self {
        let [columns, rows] = size_m.map(|length_m| (length_m * texels_per_m).ceil() as usize);
        let mut texels = Vec::with_capacity(columns * rows);
        for i in 0..columns {
            let x_m = corner_m[0] + (i as f32 + 0.5) / texels_per_m;
            texels.extend((0..rows).map(|j| color(x_m, corner_m[1] + (j as f32 + 0.5) / texels_per_m)));
        }
        Self { height_m, corner_m, texture: Texture::unfiltered(columns, rows, texels, texels_per_m) }
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn rays_enter_by_the_side_that_faces_them() {
        let block = Block::upright([10.0, 5.0], [2.0, 1.0], [0.0, 3.0], [0; 4], 0);
        for (from, to, side, entry) in [
            ([20.0, 5.0], [-1.0, 0.0], 0, 8.0),
            ([10.0, 9.0], [0.0, -1.0], 1, 3.0),
            ([0.0, 5.5], [1.0, 0.0], 2, 8.0),
            ([11.0, 0.0], [0.0, 1.0], 3, 4.0),
        ] {
            let inverse = block.turned(to).map(|d| 1.0 / if d == 0.0 { 1e-9 } else { d });
            let crossing = block.crossing(block.local(from), inverse).expect("it meets the block");
            assert_eq!(crossing.side, side);
            assert!((crossing.entry - entry).abs() < 1e-3, "{crossing:?}");
        }
        assert_eq!(block.crossing(block.local([0.0, 0.0]), [1.0, 1e9]), None, "it passes by");
        assert_eq!(block.crossing(block.local([10.0, 5.0]), [1.0, 1e9]), None, "it begins inside");
    }

    #[test]
    fn a_turned_block_is_met_where_its_corners_say() {
        let turned_rad: f32 = 0.7;
        let direction = [turned_rad.cos(), turned_rad.sin()];
        let block = Block { direction, ..Block::upright([3.0, -2.0], [2.0, 1.0], [0.0, 1.0], [0; 4], 0) };
        for (side, corners) in [(0, [3, 0]), (1, [0, 1]), (2, [1, 2]), (3, [2, 3])] {
            let [a, b] = corners.map(|corner| block.corners_m()[corner]);
            let middle = [0.5 * (a[0] + b[0]), 0.5 * (a[1] + b[1])];
            let normal = block.normal(side);
            let from = [middle[0] + 5.0 * normal[0], middle[1] + 5.0 * normal[1]];
            let inverse = block.turned([-normal[0], -normal[1]]).map(|d| 1.0 / if d.abs() < 1e-9 { 1e-9 } else { d });
            let crossing = block.crossing(block.local(from), inverse).expect("it meets the block");
            assert_eq!(crossing.side, side);
            assert!((crossing.entry - 5.0).abs() < 1e-3, "{crossing:?}");
        }
    }
}
