//! Opens the camera and agrees with it on size, rate and controls.
//!
//! The crate v4l gives the request numbers, the structures of `<linux/videodev2.h>` and the calls. Its own device and
//! stream are not used: they panic on a camera whose name is not UTF-8 or whose colour space they do not know, and on
//! errors while closing, and after a time-out the stream queues a buffer that the driver still owns, for ever (v4l
//! 0.14; raymanfx/libv4l-rs 58, 89, 98).

use std::{
    ffi::{c_int, c_void},
    io,
    os::fd::{AsRawFd, FromRawFd, OwnedFd},
    time::Duration,
};

use rustix::{fs::OFlags, io::Errno};
use tracing::{info, warn};
use v4l::{
    v4l_sys::*,
    v4l2::{self, vidioc},
};

use super::{
    super::{
        CameraEvent, CameraFacts, DeviceError, Stop,
        mjpeg::MjpegMender,
        refused_by_sandbox,
        yuyv::{YuyvEncoder, YuyvFormat},
    },
    PixelFormat, Settings,
    capture::{Capture, Converter},
    stream::Stream,
};
use crate::types::Clock;

pub(super) const CAPTURE: u32 = v4l2_buf_type_V4L2_BUF_TYPE_VIDEO_CAPTURE;
const MJPG: FourCc = FourCc(*b"MJPG");
const YUYV: FourCc = FourCc(*b"YUYV");
/// Enumerations end there at the latest, whatever the driver says.
const MAX_ENUMERATED: u32 = 64;

/// Captures until told to stop or until the camera is gone.
pub fn run(
    settings: &Settings,
    clock: &dyn Clock,
    stop: &Stop,
    emit: &mut dyn FnMut(CameraEvent),
) -> Result<(), DeviceError> {
    let device = Device::open(settings)?;
    let name = device.check_capabilities()?;
    let format = device.negotiate_format(settings)?;
    let frame_rate_hz = device.negotiate_rate(settings);
    device.set_controls(settings);
    let converter = format.converter(settings).map_err(|what| device.unsupported(what))?;
    let mut stream = Stream::start(&device, settings.buffers, format.image_bytes())?;
    let facts = CameraFacts {
        name,
        width_px: format.width_px,
        height_px: format.height_px,
        frame_rate_hz,
        pixel_format: format.code.to_string(),
    };
    info!(device = device.path, camera = facts.name, facts.width_px, facts.height_px, frame_rate_hz, "camera opened");
    emit(CameraEvent::Opened(facts));
    let capture = Capture {
        device: device.path.clone(),
        frame_timeout: Duration::from_millis(settings.frame_timeout_ms),
        buffers: stream.buffers(),
        converter,
    };
    capture.run(&mut stream, clock, stop, emit)
}

/// The name of a pixel format: four characters.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
struct FourCc([u8; 4]);

impl std::fmt::Display for FourCc {
    fn fmt(&self, f: &mut std::fmt::Formatter<'_>) -> std::fmt::Result {
        f.write_str(String::from_utf8_lossy(&self.0).trim_end())
    }
}

/// What the driver granted.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
struct Format {
    code: FourCc,
    width_px: u32,
    height_px: u32,
    bytes_per_line: u32,
    full_range: bool,
}

impl Format {
    fn converter(&self, settings: &Settings) -> Result<Converter, String> {
        if self.code == MJPG {
            return Ok(Converter::Mjpeg(MjpegMender::new(self.width_px, self.height_px)));
        }
        Ok(Converter::Yuyv(YuyvEncoder::new(self.yuyv(), settings.jpeg_quality)?.into(), Vec::new()))
    }

    fn yuyv(&self) -> YuyvFormat {
        let &Self { width_px, height_px, bytes_per_line, full_range, .. } = self;
        YuyvFormat { width_px, height_px, bytes_per_line, full_range }
    }

    /// A buffer must hold at least this much.
    fn image_bytes(&self) -> usize {
        if self.code == YUYV { self.width_px as usize * self.height_px as usize * 2 } else { 1 }
    }
}

/// Structures of `<linux/videodev2.h>` that are passed to the driver.
///
/// # Safety
/// Plain C data: every bit pattern that the kernel may write is valid, all zeros too, and the kernel follows no pointer
/// in it as we fill it in.
pub(super) unsafe trait Argument: Copy {
    fn zeroed() -> Self {
        // SAFETY: by the trait's contract.
        unsafe { std::mem::zeroed() }
    }
}

// SAFETY: integers, arrays and unions of such. Pointers in unions of `v4l2_buffer` and `v4l2_format` are followed only
// for multi-planar, user-pointer and overlay types, which are never asked for here.
unsafe impl Argument for v4l2_capability {}
// SAFETY: as above.
unsafe impl Argument for v4l2_fmtdesc {}
// SAFETY: as above.
unsafe impl Argument for v4l2_frmsizeenum {}
// SAFETY: as above.
unsafe impl Argument for v4l2_format {}
// SAFETY: as above.
unsafe impl Argument for v4l2_streamparm {}
// SAFETY: as above.
unsafe impl Argument for v4l2_control {}
// SAFETY: as above.
unsafe impl Argument for v4l2_requestbuffers {}
// SAFETY: as above.
unsafe impl Argument for v4l2_buffer {}
// SAFETY: an integer.
unsafe impl Argument for c_int {}

pub(super) struct Device {
    pub fd: OwnedFd,
    /// For messages.
    pub path: String,
}

impl Device {
    fn open(settings: &Settings) -> Result<Self, DeviceError> {
        let path = settings.device.display().to_string();
        // Also keeps a path with a zero byte from the crate, which would panic.
        settings.check().map_err(|what| DeviceError::Unsupported { device: path.clone(), what })?;
        let flags = OFlags::RDWR | OFlags::NONBLOCK | OFlags::CLOEXEC;
        match v4l2::open(&settings.device, flags.bits() as i32) {
            // SAFETY: just opened, and nobody else knows it.
            Ok(fd) => Ok(Self { fd: unsafe { OwnedFd::from_raw_fd(fd) }, path }),
            Err(error) => Err(match Errno::from_io_error(&error) {
                Some(Errno::NOENT | Errno::NODEV | Errno::NXIO | Errno::NOTDIR) => {
                    DeviceError::NotPresent { device: path }
                }
                Some(Errno::PERM) => refused_by_sandbox(path),
                Some(Errno::ACCESS) => DeviceError::NotPermitted {
                    device: path,
                    hint: "add the user to the group video, `sudo usermod -aG video USER`, and log in again".into(),
                },
                Some(Errno::BUSY) => DeviceError::Busy { device: path },
                _ => DeviceError::Io { device: path, source: error },
            }),
        }
    }

    /// One request to the driver.
    pub fn ioctl<T: Argument>(&self, request: vidioc::_IOC_TYPE, argument: &mut T) -> Result<(), Errno> {
        const SIZE_SHIFT: u32 = 16;
        const SIZE_MASK: usize = 0x3FFF;
        assert_eq!((request >> SIZE_SHIFT) as usize & SIZE_MASK, size_of::<T>(), "request {request:#x}");
        loop {
            // SAFETY: the kernel reads and writes as many bytes as the request says, which are those of `T`; what it
            // may write there, `Argument` allows.
            let answer = unsafe { v4l2::ioctl(self.fd.as_raw_fd(), request, (argument as *mut T).cast::<c_void>()) };
            match answer.map_err(|error| Errno::from_io_error(&error).unwrap_or(Errno::IO)) {
                Err(Errno::INTR) => {}
                answer => return answer,
            }
        }
    }

    /// What a request's failure means while the camera is set up.
    pub fn fault(&self, call: &str, errno: Errno) -> DeviceError {
        let device = self.path.clone();
        match errno {
            Errno::BUSY => DeviceError::Busy { device },
            Errno::NODEV | Errno::NXIO => DeviceError::Disconnected { device },
            Errno::NOSPC => self.unsupported(
                "the USB bus has no bandwidth left for it; use another USB port, a lower rate or size, or MJPG".into(),
            ),
            errno => {
                let source = io::Error::new(io::Error::from(errno).kind(), format!("{call}: {errno}"));
                DeviceError::Io { device, source }
            }
        }
    }

    pub fn unsupported(&self, what: String) -> DeviceError {
        DeviceError::Unsupported { device: self.path.clone(), what }
    }

    /// What the camera calls itself.
    fn check_capabilities(&self) -> Result<String, DeviceError> {
        let mut found = v4l2_capability::zeroed();
        self.ioctl(vidioc::VIDIOC_QUERYCAP, &mut found).map_err(|errno| match errno {
            Errno::NOTTY | Errno::INVAL => self.unsupported("it is no video device".into()),
            errno => self.fault("QUERYCAP", errno),
        })?;
        let of_the_node = found.capabilities & V4L2_CAP_DEVICE_CAPS != 0;
        let capabilities = if of_the_node { found.device_caps } else { found.capabilities };
        if capabilities & V4L2_CAP_VIDEO_CAPTURE == 0 {
            return Err(self.unsupported(
                "it does not capture images; a camera may have a second device for metadata: take the one that ends \
                 in `-video-index0` in /dev/v4l/by-id"
                    .into(),
            ));
        }
        if capabilities & V4L2_CAP_STREAMING == 0 {
            return Err(self.unsupported("its driver has no streaming buffers".into()));
        }
        let end = found.card.iter().position(|&byte| byte == 0).unwrap_or(found.card.len());
        Ok(String::from_utf8_lossy(&found.card[..end]).into_owned())
    }

    fn negotiate_format(&self, settings: &Settings) -> Result<Format, DeviceError> {
        let offered = self.formats();
        let code = match settings.pixel_format {
            PixelFormat::Mjpg => MJPG,
            PixelFormat::Yuyv => YUYV,
            PixelFormat::Auto if !offered.contains(&MJPG) && offered.contains(&YUYV) => YUYV,
            PixelFormat::Auto => MJPG,
        };
        let mut format = v4l2_format::zeroed();
        format.type_ = CAPTURE;
        // SAFETY: the member that belongs to the type `CAPTURE`; integers only.
        let wanted = unsafe { &mut format.fmt.pix };
        (wanted.width, wanted.height) = (settings.width_px, settings.height_px);
        wanted.pixelformat = u32::from_le_bytes(code.0);
        match self.ioctl(vidioc::VIDIOC_S_FMT, &mut format) {
            Ok(()) => {}
            Err(Errno::INVAL) => return Err(self.refuse(settings, code, "refuses it", &offered)),
            Err(errno) => return Err(self.fault("S_FMT", errno)),
        }
        // Drivers change what they do not like; what counts is what they say afterwards.
        self.ioctl(vidioc::VIDIOC_G_FMT, &mut format).map_err(|errno| self.fault("G_FMT", errno))?;
        // SAFETY: as above.
        let granted = unsafe { format.fmt.pix };
        let found = Format {
            code: FourCc(granted.pixelformat.to_le_bytes()),
            width_px: granted.width,
            height_px: granted.height,
            bytes_per_line: granted.bytesperline,
            // V4L2_MAP_QUANTIZATION_DEFAULT for Y'CbCr.
            full_range: granted.quantization == v4l2_quantization_V4L2_QUANTIZATION_FULL_RANGE
                || granted.quantization == v4l2_quantization_V4L2_QUANTIZATION_DEFAULT
                    && granted.colorspace == v4l2_colorspace_V4L2_COLORSPACE_JPEG,
        };
        if found.code != code {
            return Err(self.refuse(settings, code, &format!("gives {}", found.code), &offered));
        }
        if (found.width_px, found.height_px) != (settings.width_px, settings.height_px) {
            let what = format!("gives {} x {}", found.width_px, found.height_px);
            if !settings.accept_other_size {
                return Err(self.refuse(settings, code, &what, &offered));
            }
            warn!(device = self.path, found.width_px, found.height_px, "the camera gives another size than asked for");
        }
        Ok(found)
    }

    fn refuse(&self, settings: &Settings, code: FourCc, what: &str, offered: &[FourCc]) -> DeviceError {
        let offers: Vec<String> =
            offered.iter().map(|&code| format!("{code} {}", self.sizes(code).join(" ")).trim_end().into()).collect();
        let offers = if offers.is_empty() { "nothing that it names".into() } else { offers.join("; ") };
        let Settings { width_px, height_px, .. } = settings;
        self.unsupported(format!("asked for {code} {width_px}x{height_px}, it {what}; it offers {offers}"))
    }

    fn formats(&self) -> Vec<FourCc> {
        let described = (0..MAX_ENUMERATED).map_while(|index| {
            let mut description = v4l2_fmtdesc { index, type_: CAPTURE, ..v4l2_fmtdesc::zeroed() };
            self.ioctl(vidioc::VIDIOC_ENUM_FMT, &mut description).ok()?;
            Some(FourCc(description.pixelformat.to_le_bytes()))
        });
        described.collect()
    }

    /// As text, for people.
    fn sizes(&self, code: FourCc) -> Vec<String> {
        let described = (0..MAX_ENUMERATED).map_while(|index| {
            let pixel_format = u32::from_le_bytes(code.0);
            let mut size = v4l2_frmsizeenum { index, pixel_format, ..v4l2_frmsizeenum::zeroed() };
            self.ioctl(vidioc::VIDIOC_ENUM_FRAMESIZES, &mut size).ok()?;
            // SAFETY: both members are integers only, and the larger one was zeroed.
            let (one, range) = unsafe { (size.__bindgen_anon_1.discrete, size.__bindgen_anon_1.stepwise) };
            Some(if size.type_ == v4l2_frmsizetypes_V4L2_FRMSIZE_TYPE_DISCRETE {
                format!("{}x{}", one.width, one.height)
            } else {
                format!("{}x{} to {}x{}", range.min_width, range.min_height, range.max_width, range.max_height)
            })
        });
        described.collect()
    }

    /// The rate that the camera says it will keep, 0 if it says nothing. Another rate is no reason not to record.
    fn negotiate_rate(&self, settings: &Settings) -> f64 {
        let wanted_hz = settings.frame_rate_hz;
        let mut parameters = v4l2_streamparm::zeroed();
        parameters.type_ = CAPTURE;
        // Thousandths, for rates such as 7.5.
        let scale: u32 = if wanted_hz.fract() == 0.0 { 1 } else { 1000 };
        let interval = v4l2_fract { numerator: scale, denominator: (wanted_hz * f64::from(scale)).round() as u32 };
        parameters.parm.capture = v4l2_captureparm {
            // SAFETY: the member that belongs to the type `CAPTURE`, and all zeros.
            timeperframe: interval,
            ..unsafe { parameters.parm.capture }
        };
        let set = self.ioctl(vidioc::VIDIOC_S_PARM, &mut parameters);
        let read = self.ioctl(vidioc::VIDIOC_G_PARM, &mut parameters);
        // SAFETY: as above.
        let granted = unsafe { parameters.parm.capture.timeperframe };
        if read.is_err() || granted.numerator == 0 || granted.denominator == 0 {
            info!(device = self.path, wanted_hz, ?set, "the camera does not say its frame rate");
            return 0.0;
        }
        let granted_hz = f64::from(granted.denominator) / f64::from(granted.numerator);
        if (granted_hz - wanted_hz).abs() > 0.01 * wanted_hz {
            warn!(device = self.path, wanted_hz, granted_hz, "the camera grants another frame rate than asked for");
        }
        granted_hz
    }

    /// Not every camera has them: what it refuses stays as it is.
    fn set_controls(&self, settings: &Settings) {
        let set = |name: &str, id: u32, value: i32| {
            if let Err(errno) = self.ioctl(vidioc::VIDIOC_S_CTRL, &mut v4l2_control { id, value }) {
                info!(device = self.path, control = name, value, %errno, "the camera does not take this setting");
            }
        };
        if let Some(power_line_hz) = settings.power_line_hz {
            let value = match power_line_hz {
                50 => v4l2_power_line_frequency_V4L2_CID_POWER_LINE_FREQUENCY_50HZ,
                60 => v4l2_power_line_frequency_V4L2_CID_POWER_LINE_FREQUENCY_60HZ,
                _ => v4l2_power_line_frequency_V4L2_CID_POWER_LINE_FREQUENCY_DISABLED,
            };
            set("power line frequency", V4L2_CID_POWER_LINE_FREQUENCY, value as i32);
        }
        let priority = i32::from(settings.exposure_auto_priority);
        set("exposure auto priority", V4L2_CID_EXPOSURE_AUTO_PRIORITY, priority);
    }
}
