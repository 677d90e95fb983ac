//! Symmetric positive definite systems whose rows begin late: a chain of frames with a few cross-links.
//!
//! Row i of the lower triangle is kept from its first entry that is not zero. The Cholesky factor has the same
//! envelope (George & Liu 1981, section 4.2), so that a chain costs O(n) and a cross-link only the rows it spans.

/// The lower triangle, row by row.
#[derive(Debug, Clone)]
pub struct Skyline {
    /// First column kept of each row.
    first: Vec<usize>,
    /// Row i, columns `first[i]..=i`.
    rows: Vec<Vec<f64>>,
}

/// L of L Lᵀ.
#[derive(Debug, Clone)]
pub struct SkylineFactor(Skyline);

impl Skyline {
    /// Zeros; row i may be filled from column `first[i]` ≤ i on.
    pub fn zeros(first: Vec<usize>) -> Self {
        let rows = first.iter().enumerate().map(|(i, &first)| vec![0.0; i + 1 - first]).collect();
        Self { first, rows }
    }

    /// Adds to the entry at (i, j), and so to the one at (j, i).
    ///
    /// # Panics
    /// Outside the envelope.
    pub fn add(&mut self, i: usize, j: usize, value: f64) {
        let (row, column) = (i.max(j), i.min(j));
        self.rows[row][column - self.first[row]] += value;
    }

    /// `None` when the matrix is not positive definite in floating point.
    pub fn factorize(mut self) -> Option<SkylineFactor> {
        for i in 0..self.rows.len() {
            let (before, rest) = self.rows.split_at_mut(i);
            let (first_i, row_i) = (self.first[i], &mut rest[0]);
            for j in first_i..i {
                let (first_j, row_j) = (self.first[j], &before[j]);
                let from = first_i.max(first_j);
                let known = dot(&row_i[from - first_i..j - first_i], &row_j[from - first_j..j - first_j]);
                row_i[j - first_i] = (row_i[j - first_i] - known) / row_j[j - first_j];
            }
            let (diagonal, left) = row_i.split_last_mut()?;
            let pivot = *diagonal - dot(left, left);
            // Also false for a number that is none.
            if !(pivot > 0.0 && pivot.is_finite()) {
                return None;
            }
            *diagonal = pivot.sqrt();
        }
        Some(SkylineFactor(self))
    }
}

impl SkylineFactor {
    /// `b` becomes the solution of L Lᵀ x = b.
    pub fn solve(&self, b: &mut [f64]) {
        let Skyline { first, rows } = &self.0;
        for (i, row) in rows.iter().enumerate() {
            let (&diagonal, left) = row.split_last().expect("a row has its diagonal");
            b[i] = (b[i] - dot(left, &b[first[i]..i])) / diagonal;
        }
        for (i, row) in rows.iter().enumerate().rev() {
            let (&diagonal, left) = row.split_last().expect("a row has its diagonal");
            b[i] /= diagonal;
            let x = b[i];
            b[first[i]..i].iter_mut().zip(left).for_each(|(b, l)| *b -= l * x);
        }
    }

    /// [A⁻¹]_ii = |L⁻¹ e_i|².
    pub fn inverse_diagonal(&self, i: usize) -> f64 {
        let Skyline { first, rows } = &self.0;
        let mut y = vec![0.0; rows.len()];
        for k in i..rows.len() {
            let (&diagonal, left) = rows[k].split_last().expect("a row has its diagonal");
            let from = first[k].max(i).min(k);
            let right = f64::from(u8::from(k == i));
            y[k] = (right - dot(&left[from - first[k]..], &y[from..k])) / diagonal;
        }
        dot(&y, &y)
    }

    pub fn log_determinant(&self) -> f64 {
        self.0.rows.iter().map(|row| 2.0 * row.last().expect("a row has its diagonal").ln()).sum()
    }
}

/// Sum of products, in eight lanes: a compiler may not reorder a sum of floats by itself.
fn dot(a: &[f64], b: &[f64]) -> f64 {
    let ((a8, a_rest), (b8, b_rest)) = (a.as_chunks::<8>(), b.as_chunks::<8>());
    let mut lanes = [0.0; 8];
    for (a, b) in a8.iter().zip(b8) {
        for lane in 0..8 {
            lanes[lane] += a[lane] * b[lane];
        }
    }
    lanes.iter().sum::<f64>() + a_rest.iter().zip(b_rest).map(|(a, b)| a * b).sum::<f64>()
}

#[cfg(test)]
mod tests {
    use super::*;

    /// A chain of twenty with a link from 17 to 2 and a last row that sees everything.
    fn chain() -> (Skyline, Vec<Vec<f64>>) {
        let n = 20;
        let mut first: Vec<usize> = (0..n).map(|i: usize| i.saturating_sub(2)).collect();
        (first[17], first[n - 1]) = (2, 0);
        let mut dense = vec![vec![0.0; n]; n];
        let mut skyline = Skyline::zeros(first);
        let links = (0..n).flat_map(|i| (0..=i).map(move |j| (i, j)));
        for (i, j) in links.filter(|&(i, j)| i - j < 3 || (i, j) == (17, 2) || i == n - 1) {
            let value = if i == j { 9.0 } else { ((3 * i + j) as f64).sin() };
            skyline.add(j, i, value);
            (dense[i][j], dense[j][i]) = (value, value);
        }
        (skyline, dense)
    }

    #[test]
    fn the_solution_solves_and_the_inverse_is_one() {
        let (skyline, dense) = chain();
        let factor = skyline.factorize().expect("diagonally dominant enough");
        let mut log_determinant = 0.0;
        let reference = faer::Mat::from_fn(20, 20, |i, j| dense[i][j]).llt(faer::Side::Lower).expect("definite");
        for i in 0..20 {
            let mut x = vec![0.0; 20];
            x[i] = 1.0;
            factor.solve(&mut x);
            for (j, row) in dense.iter().enumerate() {
                assert!((dot(row, &x) - f64::from(u8::from(i == j))).abs() < 1e-12);
            }
            assert!((factor.inverse_diagonal(i) - x[i]).abs() < 1e-12);
            log_determinant += 2.0 * reference.L()[(i, i)].ln();
        }
        assert!((factor.log_determinant() - log_determinant).abs() < 1e-10);
    }

    #[test]
    fn what_is_not_positive_definite_is_refused() {
        let (mut skyline, _) = chain();
        skyline.add(5, 5, -20.0);
        assert!(skyline.factorize().is_none());
        let (mut skyline, _) = chain();
        skyline.add(7, 7, f64::NAN);
        assert!(skyline.factorize().is_none());
    }
}
