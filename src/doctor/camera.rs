//! The camera: is it there, is it fast enough, and does it look through the lens?

use std::{path::Path, sync::Arc, time::Duration};

use super::{Finding, advice, fault, look_at};
use crate::{
    calibrate::{DonutFinder, Verdict as DonutVerdict},
    config::Camera,
    devices::{CameraEvent, CameraFacts, DeviceError},
    jpeg::LumaDecoder,
    map::MapInfo,
    runtime::{
        live::DeviceRun,
        localize::lens_check::{LensCheck, LensVerdict},
    },
    types::{Clock, DonutCalibration, NS_PER_S},
};

/// A camera that starts slowly has so long.
const LIMIT: Duration = Duration::from_secs(12);
/// Frames that are looked at: at 30 a second, three seconds.
const FRAMES: usize = 90;
/// The first frames come while the camera finds its exposure.
const SETTLING: usize = 10;
/// The lens is looked for in every so many of them.
const LENS_EVERY: usize = 10;
/// A lower share of the rate that was asked for is worth a word.
const LEAST_RATE: f64 = 0.9;
/// A higher share of frames that cannot be used is.
const MOST_DAMAGED: f64 = 0.02;
/// A lens that is elsewhere by more has slipped \[px\].
const SLIPPED_PX: f64 = 3.0;

const MOUNT: &str = "is the lens on, in focus, and is there light? `omniloc calibrate` shows a picture of what it sees";

/// What was seen of the camera.
#[derive(Debug, Default)]
pub struct Look {
    pub facts: Option<CameraFacts>,
    /// Stamps of the frames.
    pub stamps_ns: Vec<u64>,
    pub bytes: usize,
    pub damaged: usize,
    pub lost: u64,
    /// Some of them.
    pub jpegs: Vec<Vec<u8>>,
    pub error: Option<DeviceError>,
}

impl Look {
    pub fn at(camera: DeviceRun<CameraEvent>, clock: &Arc<dyn Clock>) -> Self {
        let mut look = Self::default();
        let outcome = look_at(camera, clock, LIMIT, |event, _| {
            match event {
                CameraEvent::Opened(facts) => look.facts = Some(facts),
                CameraEvent::Lost(lost) => look.lost += lost.count,
                CameraEvent::Frame(frame) => {
                    if frame.damage.is_some() {
                        look.damaged += 1;
                    } else if look.stamps_ns.len() >= SETTLING && look.stamps_ns.len().is_multiple_of(LENS_EVERY) {
                        look.jpegs.push(frame.jpeg.to_vec());
                    }
                    look.bytes += frame.jpeg.len();
                    look.stamps_ns.push(frame.stamp_ns);
                }
            }
            look.stamps_ns.len() < FRAMES
        });
        look.error = outcome.err();
        look
    }

    /// Frames a second, once it has settled.
    fn rate_hz(&self) -> Option<f64> {
        let settled = self.stamps_ns.get(SETTLING..)?;
        let (first, last) = (settled.first()?, settled.last()?);
        (last > first).then(|| (settled.len() - 1) as f64 * NS_PER_S as f64 / (last - first) as f64)
    }

    pub fn bytes_per_s(&self) -> Option<f64> {
        Some(self.rate_hz()? * self.bytes as f64 / self.stamps_ns.len() as f64)
    }
}

/// What the camera is to look through.
pub enum Expected {
    /// The lens of this calibration, if there is one yet.
    Calibration(Option<DonutCalibration>),
    /// That of a map.
    Map(Box<MapInfo>),
}

pub fn findings(look: &Look, chosen: &Camera, expected: &Expected) -> Vec<Finding> {
    let (asked_hz, device) = match chosen {
        Camera::V4l2(settings) => (Some(settings.frame_rate_hz), Some(settings.device.as_path())),
        _ => (look.facts.as_ref().map(|facts| facts.frame_rate_hz).filter(|rate_hz| *rate_hz > 0.0), None),
    };
    let mut findings = Vec::new();
    if let Some(error) = &look.error {
        let list = Path::new("/dev/v4l/by-id");
        findings.push(Finding::problem("camera", fault(error), advice(error, "device", list)));
    }
    let Some(facts) = &look.facts else {
        if findings.is_empty() {
            findings.push(Finding::problem("camera", "it could not be opened", "plug it out and in again"));
        }
        return findings;
    };
    let at = device.map_or(String::new(), |device| format!(" at {}", device.display()));
    let CameraFacts { name, width_px, height_px, pixel_format, .. } = facts;
    findings.push(Finding::ok("camera", format!("{name}{at}: {width_px} x {height_px} px, {pixel_format}")));
    findings.push(rate(look, asked_hz));
    findings.extend(quality(look));
    findings.extend(match expected {
        Expected::Calibration(known) => lens(look, known.as_ref()),
        Expected::Map(info) => lens_of_map(look, info),
    });
    findings
}

fn rate(look: &Look, asked_hz: Option<f64>) -> Finding {
    let Some(rate_hz) = look.rate_hz() else {
        let found = format!("{} frames came in {} s", look.stamps_ns.len(), LIMIT.as_secs());
        return Finding::problem("frame rate", found, "check cable and power; plug the camera out and in again");
    };
    let found = |asked_hz: f64| format!("{rate_hz:.1} frames a second, {asked_hz:.1} asked for");
    match asked_hz {
        Some(asked_hz) if rate_hz < LEAST_RATE * asked_hz => Finding::warning(
            "frame rate",
            found(asked_hz),
            "more light; a USB port of its own; another size or rate in [camera]",
        ),
        Some(asked_hz) => Finding::ok("frame rate", found(asked_hz)),
        None => Finding::ok("frame rate", format!("{rate_hz:.1} frames a second")),
    }
}

fn quality(look: &Look) -> Option<Finding> {
    let frames = look.stamps_ns.len() as f64 + look.lost as f64;
    let bad = look.damaged as f64 + look.lost as f64;
    (bad > MOST_DAMAGED * frames).then(|| {
        let found = format!("{} of {} frames damaged, {} lost", look.damaged, look.stamps_ns.len(), look.lost);
        Finding::warning("frames", found, "a shorter cable, no hub, a USB port that nothing else uses")
    })
}

/// Whether the donut is seen, and where it should be.
fn lens(look: &Look, calibration: Option<&DonutCalibration>) -> Option<Finding> {
    let facts = look.facts.as_ref()?;
    let mut decoder = LumaDecoder::new();
    let mut finder = DonutFinder::new(facts.width_px as usize, facts.height_px as usize).ok()?;
    let mut frames = 0;
    for jpeg in &look.jpegs {
        let added = decoder.decode(jpeg).map(|image| finder.add(image));
        frames += usize::from(matches!(added, Ok(Ok(()))));
    }
    if frames == 0 {
        return None;
    }
    let donut = match finder.finish() {
        Ok(donut) => donut,
        Err(error) => return Some(Finding::warning("lens", error.to_string(), MOUNT)),
    };
    let (x_px, y_px) = (donut.center_x_px, donut.center_y_px);
    let (inner_px, outer_px) = (donut.inner_radius_px, donut.outer_radius_px);
    let found = format!("donut at ({x_px:.1}, {y_px:.1}), radii {inner_px:.1} .. {outer_px:.1} px");
    if let DonutVerdict::Doubtful(why) = &donut.verdict {
        return Some(Finding::warning("lens", format!("{found}, doubtful: {}", why.join("; ")), MOUNT));
    }
    let Some(known) = calibration else {
        let advice = "omniloc calibrate, and name its file in [vehicle] of the configuration";
        return Some(Finding::warning("lens", format!("{found}; not calibrated"), advice));
    };
    let away_px = libm::hypot(x_px - known.center_x_px, y_px - known.center_y_px);
    let grown_px = (inner_px - known.inner_radius_px).abs().max((outer_px - known.outer_radius_px).abs());
    if away_px.max(grown_px) > SLIPPED_PX {
        let found = format!("{found}, {away_px:.1} px from the calibration, radii up to {grown_px:.1} px off");
        return Some(Finding::warning("lens", found, "fasten the lens, then calibrate again: omniloc calibrate"));
    }
    Some(Finding::ok("lens", format!("{found}, as calibrated")))
}

/// Whether localizing will take this for the lens of the map: by the same measures, on fewer frames.
fn lens_of_map(look: &Look, info: &MapInfo) -> Option<Finding> {
    let facts = look.facts.as_ref()?;
    let size_px = [facts.width_px as usize, facts.height_px as usize];
    if size_px != info.image_size_px {
        let ([width_px, height_px], [map_width_px, map_height_px]) = (size_px, info.image_size_px);
        let found = format!("images of {width_px} x {height_px} px; the map's are {map_width_px} x {map_height_px} px");
        let advice = "set width_px and height_px in [camera] to the map's, or train a map with this camera";
        return Some(Finding::problem("lens", found, advice));
    }
    let mut check = LensCheck::new(&info.calibration);
    let verdict = look.jpegs.iter().find_map(|jpeg| check.look(jpeg));
    Some(match verdict {
        Some(LensVerdict::Fits) => Finding::ok("lens", "that of the map, where the map has it"),
        Some(LensVerdict::Slipped { by_px: [x_px, y_px], .. }) => {
            let found = format!("that of the map, slipped by ({x_px:.1}, {y_px:.1}) px: the panorama follows it");
            Finding::warning("lens", found, "fasten it")
        }
        Some(LensVerdict::Other(what)) => {
            let advice = "mount the lens of the map, or train a map with this one";
            Finding::problem("lens", format!("another than the map's: {what}"), advice)
        }
        Some(LensVerdict::Unclear(_)) | None => Finding::warning("lens", "it is not seen clearly", MOUNT),
    })
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::{devices::camera_v4l2, doctor::Verdict};

    fn chosen() -> Camera {
        let settings = "device = \"/dev/video0\"\nwidth_px = 1280\nheight_px = 720\nframe_rate_hz = 30.0";
        Camera::V4l2(toml::from_str::<camera_v4l2::Settings>(settings).expect("settings"))
    }

    /// A camera of so many frames a second, for three seconds.
    fn look(rate_hz: f64) -> Look {
        let facts = CameraFacts {
            name: "C310".into(),
            width_px: 1280,
            height_px: 720,
            frame_rate_hz: 30.0,
            pixel_format: "MJPG".into(),
        };
        let stamps_ns = (0..90).map(|i| (f64::from(i) / rate_hz * 1e9) as u64).collect();
        Look { facts: Some(facts), stamps_ns, bytes: 90 * 100_000, ..Look::default() }
    }

    fn verdicts(look: &Look) -> Vec<(&'static str, Verdict)> {
        findings(look, &chosen(), &Expected::Calibration(None))
            .iter()
            .map(|finding| (finding.check, finding.verdict))
            .collect()
    }

    #[test]
    fn a_good_camera_is_well() {
        assert_eq!(verdicts(&look(30.0)), [("camera", Verdict::Ok), ("frame rate", Verdict::Ok)]);
        let bytes_per_s = look(30.0).bytes_per_s().expect("has a rate");
        assert!((bytes_per_s / 3e6 - 1.0).abs() < 0.01, "{bytes_per_s}");
    }

    #[test]
    fn what_is_wrong_is_found() {
        let slow = findings(&look(15.0), &chosen(), &Expected::Calibration(None));
        assert_eq!(slow[1].found, "15.0 frames a second, 30.0 asked for");
        assert_eq!(slow[1].verdict, Verdict::Warning);
        let damaged = Look { damaged: 9, ..look(30.0) };
        assert_eq!(verdicts(&damaged)[2], ("frames", Verdict::Warning));
        let silent = Look { stamps_ns: Vec::new(), ..look(30.0) };
        assert_eq!(verdicts(&silent)[1], ("frame rate", Verdict::Problem));
        let absent = Look { error: Some(DeviceError::NotPresent { device: "camera".into() }), ..Look::default() };
        assert_eq!(verdicts(&absent), [("camera", Verdict::Problem)]);
    }
}
