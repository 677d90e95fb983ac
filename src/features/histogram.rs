//! Gray-level histogram: `hist`, 156 properties.

use crate::panorama::Panorama;

pub const DIMENSIONS: usize = 156;

/// y_k = number of the 128 × 128 gray values in \[k, k + 1) · 256/156 (Do et al. 2015, section 2; the bin edges are
/// ours).
pub fn describe(panorama: &Panorama, properties: &mut [f32]) {
    let mut counts = [0_u32; DIMENSIONS];
    for &value in &panorama.gray {
        let bin = (f64::from(value) * DIMENSIONS as f64 / 256.0) as usize;
        counts[bin.min(DIMENSIONS - 1)] += 1;
    }
    for (property, count) in properties.iter_mut().zip(counts) {
        *property = count as f32;
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::golden::{golden, golden_panorama, list};

    #[test]
    fn equals_the_reference_values() {
        let mut properties = vec![0.0; DIMENSIONS];
        describe(&golden_panorama(), &mut properties);
        let expected: Vec<f32> = list(&golden()["hist156_on_[0,256)"]).iter().map(|&count| count as f32).collect();
        assert_eq!(properties, expected);
    }

    #[test]
    fn every_pixel_is_counted_once_and_white_falls_into_the_last_bin() {
        let mut panorama = golden_panorama();
        panorama.gray[7] = 255.0;
        panorama.gray[8] = 0.0;
        let mut properties = vec![0.0; DIMENSIONS];
        describe(&panorama, &mut properties);
        assert_eq!(properties.iter().sum::<f32>(), 128.0 * 128.0);
        assert!(properties[0] >= 1.0 && properties[DIMENSIONS - 1] >= 1.0);
    }
}
