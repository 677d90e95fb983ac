use super::synthetic::SyntheticDonut;
use super::*;

fn conditions(seed: u64) -> Vec<(&'static str, SyntheticDonut)> {
    let day = || SyntheticDonut::day(seed);
    vec![
        ("day", day()),
        (
            "off-centre in a wide image",
            SyntheticDonut {
                size_px: [1280, 720],
                center_px: [420.7, 391.2],
                inner_radius_px: 96.4,
                outer_radius_px: 301.9,
                ..day()
            },
        ),
        ("small", SyntheticDonut { center_px: [250.2, 260.9], inner_radius_px: 36.2, outer_radius_px: 122.3, ..day() }),
        ("thin", SyntheticDonut { inner_radius_px: 140.2, ..day() }),
        ("a quarter cut", SyntheticDonut { center_px: [320.3, 152.1], ..day() }),
        ("a third cut", SyntheticDonut { center_px: [300.3, 108.1], ..day() }),
        ("cut above and below", SyntheticDonut { outer_radius_px: 265.2, ..day() }),
        ("noise of 12", SyntheticDonut { noise: 12.0, ..day() }),
        ("noise of 25", SyntheticDonut { noise: 25.0, ..day() }),
        ("night", SyntheticDonut { surround: 5.0, hub: 6.0, content: [9.0, 40.0], sky: 16.0, noise: 3.0, ..day() }),
        ("bright surround", SyntheticDonut { surround: 130.0, hub: 100.0, ..day() }),
        ("white surround", SyntheticDonut { surround: 240.0, ..day() }),
        ("defocused", SyntheticDonut { rim_width_px: 9.0, ..day() }),
        ("standing clutter", SyntheticDonut { clutter: true, ..day() }),
        ("vehicle in view", SyntheticDonut { vehicle_rad: 1.2, ..day() }),
    ]
}

#[test]
fn explore() {
    for seed in 1..=6 {
        for (name, donut) in conditions(seed) {
            for n in [1, 10] {
                match find_donut(&donut.frames(n)) {
                    Ok(e) => println!(
                        "{name:>28} seed {seed} n {n:>2}: c {:.2} in {:+.2} out {:+.2} std {:.2} {:.2} {:.2} sup {:.2}/{:.2} vis {:.2} dis {:.2} conf {:.2} {:?}",
                        (e.center_x_px - donut.center_px[0]).hypot(e.center_y_px - donut.center_px[1]),
                        e.inner_radius_px - donut.inner_radius_px,
                        e.outer_radius_px - donut.outer_radius_px,
                        e.center_x_std_px,
                        e.inner_radius_std_px,
                        e.outer_radius_std_px,
                        e.inner_rim.supported,
                        e.outer_rim.supported,
                        e.outer_rim.visible,
                        e.center_disagreement_px,
                        e.confidence,
                        e.verdict
                    ),
                    Err(e) => println!("{name:>28} seed {seed} n {n:>2}: {e}"),
                }
            }
        }
    }
}
