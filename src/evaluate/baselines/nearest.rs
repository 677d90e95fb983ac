//! Nearest learning image by its properties, each scaled to unit deviation.

use faer::{Mat, MatRef};
use rayon::prelude::*;

use crate::features::scaling::{Scaling, ScalingError, ScalingMethod};

/// For each of the rows of `queries`, the row of `learning` with the least Euclidean distance of z-scored properties
/// (n × d); the scaling is that of `learning`.
///
/// # Errors
/// The properties do not vary, or are not finite.
pub fn nearest(learning: MatRef<f64>, queries: MatRef<f64>) -> Result<Vec<usize>, ScalingError> {
    let scaling = Scaling::learn(ScalingMethod::ZScore, learning)?;
    let rows = |features: Mat<f64>| -> Vec<Vec<f32>> {
        (0..features.nrows()).map(|i| features.row(i).iter().map(|&z| z as f32).collect()).collect()
    };
    let (learning, queries) = (rows(scaling.apply(learning)), rows(scaling.apply(queries)));
    let of_query = |query: &Vec<f32>| {
        let square = |row: &[f32]| -> f32 { row.iter().zip(query).map(|(a, b)| (a - b) * (a - b)).sum() };
        let squares = learning.iter().map(|row| square(row)).enumerate();
        squares.min_by(|a, b| a.1.total_cmp(&b.1)).map_or(0, |(row, _)| row)
    };
    Ok(queries.par_iter().map(of_query).collect())
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn every_property_counts_by_its_deviation() {
        // The first property is large and says little, the second is small and says all.
        let learning = Mat::from_fn(3, 2, |i, k| if k == 0 { [0.0, 1000.0, 2000.0][i] } else { [0.0, 0.1, -0.1][i] });
        let queries = Mat::from_fn(1, 2, |_, k| if k == 0 { 900.0 } else { -0.1 });
        assert_eq!(nearest(learning.as_ref(), queries.as_ref()), Ok(vec![2]));
    }

    #[test]
    fn properties_that_do_not_vary_are_refused() {
        let same = Mat::from_fn(3, 2, |_, _| 1.0);
        assert!(nearest(same.as_ref(), same.as_ref()).is_err());
    }
}
