use proptest::prelude::*;

use super::*;
use crate::gnss::{encode, framing};

fn position(content: &str) -> PositionSaid {
    match parse(content) {
        Ok(Said::Position(said)) => said,
        other => panic!("{content}: {other:?}"),
    }
}

fn heading(content: &str) -> (Option<f64>, North) {
    match parse(content) {
        Ok(Said::Heading(said)) => (said.yaw_rad.map(f64::to_degrees), said.north),
        other => panic!("{content}: {other:?}"),
    }
}

#[test]
fn coordinates_have_the_sign_of_their_hemisphere() {
    for (fields, latitude_deg, longitude_deg) in [
        ("4730.0,N,00815.0,E", 47.5, 8.25),
        ("3356.4,S,15112.6,E", -33.94, 151.21),
        ("4046.2,N,07358.8,W", 40.77, -73.98),
        ("5448.0,S,06818.0,W", -54.8, -68.3),
        ("9000.0,N,18000.0,E", 90.0, 180.0),
    ] {
        let (place, _) = position(&format!("GNGGA,120000,{fields},1,08,0.9,1.0,M,2.0,M,,")).place.expect("a fix");
        assert!((place.latitude_deg - latitude_deg).abs() < 1e-12, "{fields}: {place:?}");
        assert!((place.longitude_deg - longitude_deg).abs() < 1e-12, "{fields}: {place:?}");
        assert_eq!(place.altitude_m, 3.0, "the geoid's separation is added");
    }
}

#[test]
fn impossible_fields_are_refused() {
    for content in [
        "GPGGA,120000,9930.0,N,00815.0,E,1,08,0.9,1.0,M,2.0,M,,",
        "GPGGA,120000,4775.0,N,00815.0,E,1,08,0.9,1.0,M,2.0,M,,",
        "GPGGA,120000,4730.0,N,18100.0,E,1,08,0.9,1.0,M,2.0,M,,",
        "GPGGA,120000,4730.0,X,00815.0,E,1,08,0.9,1.0,M,2.0,M,,",
        "GPGGA,120000,4730.0,N,0815.0,E,1,08,0.9,1.0,M,2.0,M,,",
        "GPGGA,120000,47-3.0,N,00815.0,E,1,08,0.9,1.0,M,2.0,M,,",
        "GPGGA,120000,4730.0,N,,,1,08,0.9,1.0,M,2.0,M,,",
        "GPGGA,120000,4730.0,N,00815.0,E,1,08,0.9,nan,M,2.0,M,,",
        "GPGGA,120000,4730.0,N,00815.0,E,1,08,0.9,1e9,M,2.0,M,,",
        "GPGGA,256199,4730.0,N,00815.0,E,1,08,0.9,1.0,M,2.0,M,,",
        "GPGGA,120060,4730.0,N,00815.0,E,1,08,0.9,1.0,M,2.0,M,,",
        "GPGGA,12000,4730.0,N,00815.0,E,1,08,0.9,1.0,M,2.0,M,,",
        "GPGGA,120000,4730.0,N,00815.0,E,1",
        "GNGNS,120000,4730.0,N,00815.0,E,AA,08,x,1.0,2.0,,",
        "GPRMC,120000,A,4730.0,N,00815.0,E,999999,10.0,221126,,,A",
        "GPRMC,120000,A,4730.0,N,00815.0,E,10.0,400.0,221126,,,A",
        "GPRMC,120000,A,4730.0,N,00815.0,E,10.0,40.0,320126,,,A",
        "GPZDA,120000,31,02,2026,00,00",
        "HEHDT,400.0,T",
        "HEHDT,-1.0,T",
        "HEHDT,nan,T",
        "HEHDT,10.0,M",
        "HCHDM,361.0,M",
        "HCHDG,10.0,1.0,X,,",
        "PASHR,120000.0,400.0,T,0,0,,,,,1",
        "PASHR,120000.0,10.0,M,0,0,,,,,1",
        "PASHR,120000.0,10.0,T,200,0,,,,,1",
        "PASHR,120000.0,10.0,T,0,0,,,,,x",
    ] {
        assert!(parse(content).is_err(), "{content}: {:?}", parse(content));
    }
}

#[test]
fn empty_fields_are_not_known() {
    for content in ["GPGGA,,,,,,0,,,,,,,,", "GNGNS,,,,,,NN,,,,,,,", "GPRMC,,V,,,,,,,,,,N", "GPGGA,,,,,,,,,,,,,,"] {
        let said = position(content);
        assert_eq!((said.place, said.time_ns), (None, None), "{content}");
    }
    assert_eq!(heading("HEHDT,,T").0, None);
    assert_eq!(heading("HCHDG,,,,,").0, None);
    assert_eq!(parse("GPZDA,,,,,,"), Ok(Said::Date { time_ns: None, days: None }));
    assert_eq!(parse("GPGST,,,,,,,,"), Ok(Said::Deviation { time_ns: None, std_m: None }));
}

#[test]
fn times_are_exact_and_a_leap_second_is_one() {
    for (field, expected_ns) in [
        ("000000", 0),
        ("235959.999999999", 86_399_999_999_999),
        ("081530.1", 29_730_100_000_000),
        ("235960.5", 86_400_500_000_000),
    ] {
        let said = position(&format!("GPGGA,{field},,,,,0,,,,,,,,"));
        assert_eq!(said.time_ns, Some(expected_ns), "{field}");
    }
}

#[test]
fn qualities_of_all_three_position_sentences() {
    use FixQuality::{Autonomous, DeadReckoning, Differential, RtkFixed, RtkFloat, Simulated};
    for (gga, gns, rmc, expected) in [
        ("0", "NNNN", "V,x", None),
        ("1", "ANNN", "A,A", Some(Autonomous)),
        ("2", "DAAA", "A,D", Some(Differential)),
        ("4", "RRNN", "A,R", Some(RtkFixed)),
        ("5", "AFAA", "A,F", Some(RtkFloat)),
        ("6", "E", "A,E", Some(DeadReckoning)),
        ("8", "S", "A,S", Some(Simulated)),
    ] {
        let (status, mode) = rmc.split_once(',').expect("is written so");
        for content in [
            format!("GPGGA,120000,4730.0,N,00815.0,E,{gga},08,0.9,1.0,M,2.0,M,,"),
            format!("GNGNS,120000,4730.0,N,00815.0,E,{gns},08,0.9,1.0,2.0,,"),
            format!("GPRMC,120000,{status},4730.0,N,00815.0,E,,,221126,,,{mode}"),
        ] {
            assert_eq!(position(&content).place.map(|(_, quality)| quality), expected, "{content}");
        }
    }
}

#[test]
fn headings_become_yaw_and_keep_their_north() {
    for (content, yaw_deg, north) in [
        ("HEHDT,0.0,T", 90.0, North::True),
        ("INHDT,90.0,T", 0.0, North::True),
        ("HEHDT,180.0,T", -90.0, North::True),
        ("HEHDT,270.0,T", 180.0, North::True),
        ("HEHDT,360.0,T", 90.0, North::True),
        ("HCHDM,90.0,M", 0.0, North::Magnetic),
        ("HCHDG,90.0,2.0,E,,", -2.0, North::Magnetic),
        ("HCHDG,90.0,2.0,W,5.0,E", -3.0, North::True),
        ("PASHR,120000.0,90.0,T,1.0,-2.0,,0.1,0.1,0.5,1", 0.0, North::True),
    ] {
        let (found_deg, found_north) = heading(content);
        assert!((found_deg.expect("is stated") - yaw_deg).abs() < 1e-9, "{content}: {found_deg:?}");
        assert_eq!(found_north, north, "{content}");
    }
}

#[test]
fn sentences_of_no_use_are_passed_over() {
    for content in [
        "PHTRO,10.37,P,177.62,T",
        "PRDID,-10.37,2.34,197.62",
        "PSONCMS,0.0905,0.4217,0.9020,-0.0196,-1.7685,0.3861,-9.6648,-0.0116,0.0065,-0.0080,0.0581,0.3846,-0.2,31.3",
        "HEROT,0.1,A",
        "HCMTW,27.3,C",
        "GPGSV,3,1,11,03,03,111,00",
        "PASHR,POS,0,06",
        "",
        "GP",
        ",,,",
        "GPGGAX,1",
    ] {
        assert_eq!(parse(content), Ok(Said::Nothing), "{content}");
    }
}

proptest! {
    #[test]
    fn agrees_with_crate_nmea(
        time_ms in 0..86_400_000_i64,
        latitude_deg in -89.9..89.9_f64,
        longitude_deg in -179.9..179.9_f64,
        altitude_m in -100.0..3000.0_f64,
        speed_knots in 0.0..100.0_f64,
        course_deg in 0.0..360.0_f64,
    ) {
        let time = encode::time_of_day(time_ms * 1_000_000);
        let latitude = encode::degrees_minutes(latitude_deg, 2, ['N', 'S']);
        let longitude = encode::degrees_minutes(longitude_deg, 3, ['E', 'W']);
        let gga = format!("GPGGA,{time},{latitude},{longitude},1,08,0.9,{altitude_m:.2},M,48.0,M,,");
        let gns = format!("GNGNS,{time},{latitude},{longitude},AN,08,0.9,{altitude_m:.2},48.0,,,V");
        let rmc =
            format!("GPRMC,{time},A,{latitude},{longitude},{speed_knots:.2},{course_deg:.1},221126,,,A");
        let close = |a: f64, b: f64| (a - b).abs() < 1e-9;
        for content in [gga, gns, rmc] {
            let said = position(&content);
            let (place, _) = said.place.unwrap();
            let sentence = format!("${content}*{:02X}", framing::xor(content.as_bytes()));
            let (theirs, fix_time) = match nmea::parse_str(&sentence).unwrap() {
                nmea::ParseResult::GGA(gga) => (gga.latitude.zip(gga.longitude), gga.fix_time),
                nmea::ParseResult::GNS(gns) => (gns.lat.zip(gns.lon), gns.fix_time),
                nmea::ParseResult::RMC(rmc) => {
                    prop_assert_eq!(said.days, Some(20_779));
                    let speed_mps = f64::from(rmc.speed_over_ground.unwrap()) * MPS_PER_KNOT;
                    prop_assert!(close(said.motion.speed_mps.unwrap(), speed_mps));
                    (rmc.lat.zip(rmc.lon), rmc.fix_time)
                }
                other => panic!("{other:?}"),
            };
            let (latitude_deg, longitude_deg) = theirs.unwrap();
            prop_assert!(close(place.latitude_deg, latitude_deg) && close(place.longitude_deg, longitude_deg));
            let theirs_ns = fix_time.unwrap().signed_duration_since(Default::default()).num_nanoseconds().unwrap();
            // Theirs went through a floating-point number of seconds.
            prop_assert!((said.time_ns.unwrap() - theirs_ns).abs() <= 10);
        }
    }

    #[test]
    fn any_text_is_survived(content in "[ -~]{0,100}", header in "(GPGGA|GNGNS|GPRMC|GPGST|GPZDA|HEHDT|HCHDG|PASHR|GPVTG)") {
        let _ = parse(&content);
        let _ = parse(&format!("{header},{content}"));
    }

    #[test]
    fn any_fields_are_survived(
        header in "(GPGGA|GNGNS|GPRMC|GPGST|GPZDA|HEHDT|HCHDG|PASHR|GPVTG)",
        fields in proptest::collection::vec("([0-9]{0,9}|-?[0-9]{1,3}\\.[0-9]{0,4}|[A-Z]|nan|inf|1e99|)", 0..20),
    ) {
        match parse(&format!("{header},{}", fields.join(","))) {
            Ok(Said::Position(said)) => prop_assert!(said.place.is_none_or(|(place, _)| place.is_plausible())),
            Ok(Said::Heading(said)) => prop_assert!(said.yaw_rad.is_none_or(f64::is_finite)),
            _ => {}
        }
    }
}
