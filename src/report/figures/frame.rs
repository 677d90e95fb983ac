//! One frame on its way: figure 1 of Do et al. (2015).

use serde_json::json;

use crate::panorama::{GRAY_SIZE, WIDE_COLUMNS, WIDE_ROWS};
use crate::report::chart::color::{BLUE, ColorMap, ORANGE, VERMILION};
use crate::report::chart::picture::{Rgba, png_address};
use crate::report::chart::plot::{Axis, Key, LABEL, LegendItem, Panel, Plot, Spec};
use crate::report::chart::scale::{Scale, number};
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
    let fft = photograph.fft.clone();
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
        "fft_properties": fft,
    });
    let caption = format!(
        "Frame {index}. (a) what the camera saw; (b) the same unwrapped to a panorama (turned to begin in the east where \
         the yaw is known), and below it the 128 numbers that are the paper’s FFT properties; (c) the panorama as it came, \
         reduced to the 128 × 128 gray values f[a, b] of the paper; (d) the magnitude of their two-dimensional Fourier \
         transform, on whose axes (dashed) those properties lie."
    );
    let mut figure = Figure::new(format!("{}-frame", dataset.id), TITLE, caption, data);
    figure.columns = 4;
    let mut gray =
        square_plot("(c) 128 × 128 gray image", &photograph.gray, [0.0, 255.0], ColorMap::Gray, Marks::Pixels);
    gray.color_bar("gray value", [0.0, 255.0], ColorMap::Gray);
    let panels = vec![
        donut_panel(photograph),
        panorama_panel(photograph, &fft),
        gray.finish(),
        spectrum_panel(&spectrum, [low, high]),
    ];
    figure.with_panels(panels).into()
}

/// Four beside one another on a desk.
const WIDTH_PX: f64 = 266.0;

fn donut_panel(photograph: &Photograph) -> Panel {
    let mut shapes = Shapes::default();
    shapes.text([0.0, 14.0], "(a) camera image", crate::report::chart::plot::TITLE);
    let at = [0.0, 26.0];
    shapes.image(at, [WIDTH_PX, WIDTH_PX], &photograph.donut, false);
    let [x, y, inner, outer] = photograph.rims.map(|share| share * WIDTH_PX);
    let center = [at[0] + x, at[1] + y];
    for radius in [inner, outer] {
        shapes.circle(center, radius, Paint::stroke(ORANGE, 1.5).dashed("5 3"));
    }
    shapes.line([center[0] - 5.0, center[1]], [center[0] + 5.0, center[1]], Paint::stroke(ORANGE, 1.5));
    shapes.line([center[0], center[1] - 5.0], [center[0], center[1] + 5.0], Paint::stroke(ORANGE, 1.5));
    let below = at[1] + WIDTH_PX + 16.0;
    shapes.text([0.5 * WIDTH_PX, below], "dashed: the rims as calibrated", LABEL.anchored(Anchor::Middle));
    Panel { title: "camera image".into(), size_px: [WIDTH_PX, below + 8.0], shapes }
}

/// The panorama, and below it the paper's properties.
fn panorama_panel(photograph: &Photograph, fft: &[f32]) -> Panel {
    const PICTURE_PX: f64 = WIDTH_PX * WIDE_ROWS as f64 / WIDE_COLUMNS as f64;
    const PROPERTIES_TOP_PX: f64 = 26.0 + PICTURE_PX + 30.0;
    let mut shapes = Shapes::default();
    shapes.text([0.0, 14.0], "(b) panorama", crate::report::chart::plot::TITLE);
    shapes.image([0.0, 26.0], [WIDTH_PX, PICTURE_PX], &photograph.panorama, false);
    let ends = [(0.0, "0°", Anchor::Start), (0.5, "180°", Anchor::Middle), (1.0, "360°", Anchor::End)];
    for (share, text, anchor) in ends {
        shapes.text([share * WIDTH_PX, 26.0 + PICTURE_PX + 14.0], text, LABEL.anchored(anchor));
    }
    let greatest = f64::from(fft.iter().copied().fold(1.0_f32, f32::max));
    let least = f64::from(fft.iter().copied().fold(f32::INFINITY, f32::min)).max(1.0);
    let quarters = (0..=4).map(|i| (16.0 * f64::from(i), format!("{}", 16 * i)));
    let x = Axis::new("frequency, cycles an image", Scale::linear(0.0, 64.0)).with_ticks(quarters);
    let y = Axis::new("magnitude, logarithmic", Scale::log(least, greatest));
    let mut spec = Spec::new("The paper’s FFT properties of it", x, y);
    spec.width_px = WIDTH_PX;
    spec.area_height_px = 106.0;
    let (down, along) = fft.split_at(fft.len() / 2);
    spec.legend = vec![
        LegendItem::new("|F(p, 0)|", Key::Line(Paint::stroke(VERMILION, 1.6))),
        LegendItem::new("|F(0, l)|", Key::Line(Paint::stroke(BLUE, 1.6))),
    ];
    let mut plot = Plot::new(spec);
    for (values, color) in [(down, VERMILION), (along, BLUE)] {
        let points: Vec<_> =
            (1..).zip(values).map(|(harmonic, &v)| [f64::from(harmonic), f64::from(v).max(least)]).collect();
        plot.curve(&points, Paint::stroke(color, 1.4));
    }
    let below = plot.finish();
    shapes.moved([0.0, PROPERTIES_TOP_PX], &below.shapes);
    Panel { title: "panorama".into(), size_px: [WIDTH_PX, PROPERTIES_TOP_PX + below.size_px[1]], shapes }
}

/// What the axes of a square picture count.
#[derive(Clone, Copy, PartialEq)]
enum Marks {
    Pixels,
    Frequencies,
}

fn square_plot(title: &str, values: &[f32], [low, high]: [f64; 2], map: ColorMap, marks: Marks) -> Plot {
    let n = GRAY_SIZE as f64;
    let (x, y, from) = match marks {
        Marks::Pixels => ("column b", "row a", 0.0),
        Marks::Frequencies => ("frequency l, along the horizon", "frequency p, across the horizon", -0.5 * n),
    };
    let ticks = || (0..=4).map(move |i| 0.25 * n * f64::from(i)).map(move |v| (v, number(v + from, 0)));
    let x = Axis::new(x, Scale::linear(0.0, n)).with_ticks(ticks());
    // Row 0 on top.
    let y = Axis::new(y, Scale { low: n, high: 0.0, ..Scale::linear(0.0, n) }).with_ticks(ticks());
    let mut spec = Spec::new(title, x, y);
    spec.grid = false;
    spec.width_px = WIDTH_PX;
    spec.area_height_px = 220.0;
    let mut plot = Plot::new(spec);
    let mut picture = Rgba::transparent(GRAY_SIZE, GRAY_SIZE);
    for (i, &value) in values.iter().enumerate() {
        let share = (f64::from(value) - low) / (high - low).max(f64::MIN_POSITIVE);
        picture.put(i % GRAY_SIZE, i / GRAY_SIZE, map.at(share));
    }
    let (at, size) = (plot.area_at, plot.area_size);
    plot.inside.image(at, size, &png_address(&picture), true);
    plot
}

fn spectrum_panel(spectrum: &[f32], range: [f64; 2]) -> Panel {
    let (low, high) = (range[0].max(range[1] - 5.0), range[1]);
    let title = "(d) magnitude of its transform";
    let mut plot = square_plot(title, spectrum, [low, high], ColorMap::Sequential, Marks::Frequencies);
    // The properties |F(p, 0)| and |F(0, l)|, p and l from 1 to 64.
    let (middle, end) = (0.5 * GRAY_SIZE as f64, GRAY_SIZE as f64);
    for (from, to) in [([middle, middle], [end, middle]), ([middle, middle], [middle, end])] {
        plot.segment(from, to, Paint::stroke("#ffffff", 1.4).dashed("4 3"));
    }
    plot.color_bar("log₁₀ |F(p, l)|", [low, high], ColorMap::Sequential);
    plot.finish()
}
