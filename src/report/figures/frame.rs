//! One frame on its way: figure 1 of Do et al. (2015).

use serde_json::json;

use crate::panorama::{GRAY_SIZE, WIDE_COLUMNS, WIDE_ROWS};
use crate::report::chart::color::{ColorMap, ORANGE};
use crate::report::chart::picture::{Rgba, png_address};
use crate::report::chart::plot::{Axis, LABEL, PANEL_WIDTH_PX, Panel, Plot, Spec};
use crate::report::chart::scale::Scale;
use crate::report::chart::svg::{Anchor, Paint, Shapes};
use crate::report::dataset::Dataset;
use crate::report::figure::{Drawn, Figure};
use crate::report::photograph::{Photograph, log_spectrum};

/// The frame that is shown: from the middle of the recording.
pub fn shown_row(dataset: &Dataset) -> usize {
    dataset.frames.len() / 2
}

pub fn frame(dataset: &Dataset) -> Drawn {
    const TITLE: &str = "From the camera to the properties";
    let row = shown_row(dataset);
    let Some(photograph) = dataset.photographs.get(&row) else {
        return Drawn::left_out(TITLE, "The frame in the middle of the recording could not be read.");
    };
    let index = dataset.frames[row].index;
    let spectrum = log_spectrum(&photograph.gray);
    let low = f64::from(spectrum.iter().copied().fold(f32::INFINITY, f32::min));
    let high = f64::from(spectrum.iter().copied().fold(f32::NEG_INFINITY, f32::max));
    let donut = &dataset.provenance.calibration;
    let data = json!({
        "index": index,
        "position_m": dataset.frames[row].position_m,
        "yaw_rad": dataset.frames[row].yaw_rad,
        "donut_px": {
            "center_x": donut.center_x_px, "center_y": donut.center_y_px,
            "inner_radius": donut.inner_radius_px, "outer_radius": donut.outer_radius_px,
        },
        "gray_128x128": photograph.gray,
        "log10_magnitude_128x128": spectrum,
    });
    let caption = format!(
        "Frame {index}. (a) what the camera saw, with the calibrated rims of the donut; (b) the same unwrapped to a \
         panorama; (c) reduced to the 128 × 128 gray values f[a, b] of the paper; (d) the magnitude of their \
         two-dimensional Fourier transform, on whose two axes the paper’s FFT properties lie."
    );
    let mut figure = Figure::new(format!("{}-frame", dataset.id), TITLE, caption, data);
    figure.columns = 2;
    let panels = vec![
        donut_panel(photograph),
        panorama_panel(photograph, dataset.frames[row].yaw_rad.is_some()),
        square_panel("(c) 128 × 128 gray image", "column b", "row a", &photograph.gray, [0.0, 255.0], ColorMap::Gray),
        spectrum_panel(&spectrum, [low, high]),
    ];
    figure.with_panels(panels).into()
}

fn donut_panel(photograph: &Photograph) -> Panel {
    const SIDE_PX: f64 = 330.0;
    let mut shapes = Shapes::default();
    shapes.text([0.0, 14.0], "(a) camera image", crate::report::chart::plot::TITLE);
    let at = [0.5 * (PANEL_WIDTH_PX - SIDE_PX), 26.0];
    shapes.image(at, [SIDE_PX, SIDE_PX], &photograph.donut, false);
    let [x, y, inner, outer] = photograph.rims.map(|share| share * SIDE_PX);
    for radius in [inner, outer] {
        shapes.circle([at[0] + x, at[1] + y], radius, Paint::stroke(ORANGE, 1.5).dashed("5 3"));
    }
    shapes.line([at[0] + x - 5.0, at[1] + y], [at[0] + x + 5.0, at[1] + y], Paint::stroke(ORANGE, 1.5));
    shapes.line([at[0] + x, at[1] + y - 5.0], [at[0] + x, at[1] + y + 5.0], Paint::stroke(ORANGE, 1.5));
    shapes.text(
        [0.5 * PANEL_WIDTH_PX, at[1] + SIDE_PX + 16.0],
        "dashed: inner and outer rim as calibrated",
        LABEL.anchored(Anchor::Middle),
    );
    Panel { title: "camera image".into(), size_px: [PANEL_WIDTH_PX, at[1] + SIDE_PX + 24.0], shapes }
}

fn panorama_panel(photograph: &Photograph, has_yaw: bool) -> Panel {
    let label = if has_yaw { "azimuth from east, counter-clockwise or clockwise as the lens has it [°]" } else { "azimuth [°]" };
    let x = Axis::new(label, Scale::linear(0.0, 360.0));
    let x = x.with_ticks((0..=4).map(|quarter| (90.0 * f64::from(quarter), format!("{}", 90 * quarter))));
    let y = Axis::new("row", Scale::linear(WIDE_ROWS as f64, 0.0));
    let y = Axis { scale: Scale { low: WIDE_ROWS as f64, high: 0.0, ..y.scale }, ..y };
    let mut spec = Spec::new("(b) panorama", x, y.with_ticks([0.0, 64.0, 128.0].map(|v| (v, format!("{v:.0}")))));
    spec.grid = false;
    spec.area_height_px = (PANEL_WIDTH_PX - 44.0) * WIDE_ROWS as f64 / WIDE_COLUMNS as f64;
    let mut plot = Plot::new(spec);
    let (at, size) = (plot.area_at, plot.area_size);
    plot.inside.image(at, size, &photograph.panorama, false);
    plot.finish()
}

fn square_panel(title: &str, x: &str, y: &str, values: &[f32], range: [f64; 2], map: ColorMap) -> Panel {
    square_plot(title, x, y, values, range, map).finish()
}

fn square_plot(title: &str, x: &str, y: &str, values: &[f32], [low, high]: [f64; 2], map: ColorMap) -> Plot {
    let n = GRAY_SIZE as f64;
    let ticks = || [0.0, 32.0, 64.0, 96.0, 128.0].map(|v| (v, format!("{v:.0}")));
    let x = Axis::new(x, Scale::linear(0.0, n)).with_ticks(ticks());
    let y = Axis::new(y, Scale { low: n, high: 0.0, ..Scale::linear(0.0, n) }).with_ticks(ticks());
    let mut spec = Spec::new(title, x, y);
    spec.grid = false;
    spec.area_height_px = 290.0;
    let mut plot = Plot::new(spec);
    let mut picture = Rgba::transparent(GRAY_SIZE, GRAY_SIZE);
    for (i, &value) in values.iter().enumerate() {
        picture.put(i % GRAY_SIZE, i / GRAY_SIZE, map.at((f64::from(value) - low) / (high - low).max(f64::MIN_POSITIVE)));
    }
    let (at, size) = (plot.area_at, plot.area_size);
    plot.inside.image(at, size, &png_address(&picture), true);
    plot
}

fn spectrum_panel(spectrum: &[f32], range: [f64; 2]) -> Panel {
    let half = GRAY_SIZE as f64 / 2.0;
    let title = "(d) magnitude of its Fourier transform";
    let mut plot = square_plot(title, "frequency l along the horizon", "frequency p across it", spectrum, range, ColorMap::Sequential);
    // The properties |F(p, 0)| and |F(0, l)|, p and l from 1 to 64.
    let at = |x: f64, y: f64| [x, y];
    for (from, to) in [(at(half + 1.0, half + 0.5), at(2.0 * half, half + 0.5)), (at(half + 0.5, half + 1.0), at(half + 0.5, 2.0 * half))] {
        plot.segment(from, to, Paint::stroke("#ffffff", 1.4).dashed("4 3"));
    }
    plot.color_bar("log₁₀ |F|", range, ColorMap::Sequential);
    plot.finish()
}
