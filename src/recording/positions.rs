//! `positions.csv`: the rows of a data set.

use std::{
    collections::HashMap,
    io::Read,
    path::{Component, Path, PathBuf},
};

use super::dataset::{DatasetError, IMAGES_FOLDER, POSITIONS_FILE};

pub const HEADER: [&str; 6] = ["index", "file", "x_m", "y_m", "yaw_rad", "time_s"];

/// Positions beyond this are a mistake \[m\]: UTM coordinates stay below 1e7.
const MAX_COORDINATE_M: f64 = 1e8;
/// Stamps are nanoseconds in 64 bits, and readers take them as signed \[s\].
const MAX_TIME_S: f64 = 9.2e9;

/// One row of `positions.csv`.
#[derive(Debug, Clone, PartialEq)]
pub struct Row {
    /// Line in the file, from 1.
    pub line: u64,
    pub index: u32,
    /// As written.
    pub file: String,
    /// Relative to `images/`.
    pub image: PathBuf,
    pub x_m: f64,
    pub y_m: f64,
    pub yaw_rad: Option<f64>,
    pub time_s: Option<f64>,
}

/// All rows in the order of the file, each sound by itself, no index or image there twice.
pub(super) fn read_rows(path: &Path, source: impl Read) -> Result<Vec<Row>, DatasetError> {
    let mut reader = csv::ReaderBuilder::new().has_headers(false).flexible(true).from_reader(source);
    let mut records = reader.records();
    let csv_error = |source| DatasetError::Csv { path: path.into(), source };

    let header = records.next().transpose().map_err(csv_error)?.unwrap_or_default();
    check_header(path, &header)?;

    let mut rows: Vec<Row> = Vec::new();
    let mut line_of_index = HashMap::new();
    let mut line_of_image = HashMap::new();
    for record in records {
        let row = read_row(path, &record.map_err(csv_error)?)?;
        let duplicate = |field, found: String, first: u64| DatasetError::Field {
            path: path.into(),
            line: row.line,
            field,
            expected: format!("a value that no other row has (line {first} has it too)"),
            found,
        };
        if let Some(first) = line_of_index.insert(row.index, row.line) {
            return Err(duplicate("index", row.index.to_string(), first));
        }
        if let Some(first) = line_of_image.insert(row.image.clone(), row.line) {
            return Err(duplicate("file", row.file.clone(), first));
        }
        rows.push(row);
    }
    if rows.is_empty() {
        return Err(DatasetError::NoRows { path: path.into() });
    }
    Ok(rows)
}

fn check_header(path: &Path, header: &csv::StringRecord) -> Result<(), DatasetError> {
    let found: Vec<&str> = header.iter().map(str::trim).collect();
    if found == HEADER {
        return Ok(());
    }
    let missing: Vec<&str> = HEADER.into_iter().filter(|name| !found.contains(name)).collect();
    let extra: Vec<&str> = found.iter().copied().filter(|name| !HEADER.contains(name)).collect();
    let difference = match (missing.as_slice(), extra.as_slice()) {
        ([], []) => "the columns are in another order, or one is there twice".into(),
        (missing, []) => format!("missing {}", missing.join(", ")),
        ([], extra) => format!("unexpected {}", extra.join(", ")),
        (missing, extra) => format!("missing {}; unexpected {}", missing.join(", "), extra.join(", ")),
    };
    Err(DatasetError::Header { path: path.into(), found: found.join(","), difference })
}

fn read_row(path: &Path, record: &csv::StringRecord) -> Result<Row, DatasetError> {
    let line = record.position().map_or(0, csv::Position::line);
    let fields: Vec<&str> = record.iter().map(str::trim).collect();
    let &[index, file, x_m, y_m, yaw_rad, time_s] = fields.as_slice() else {
        return Err(DatasetError::FieldCount { path: path.into(), line, found: fields.len() });
    };
    let bad = |field, expected: &str, found: &str| DatasetError::Field {
        path: path.into(),
        line,
        field,
        expected: expected.into(),
        found: found.into(),
    };
    let finite = |field, text: &str, expected: &str| {
        text.parse::<f64>().ok().filter(|number| number.is_finite()).ok_or_else(|| bad(field, expected, text))
    };
    let metres = |field, text: &str| {
        let expected = "a finite number of metres, at most 1e8";
        finite(field, text, expected)
            .and_then(|m| if m.abs() <= MAX_COORDINATE_M { Ok(m) } else { Err(bad(field, expected, text)) })
    };
    let optional = |field, text: &str, expected: &str| match text {
        "" => Ok(None),
        text => finite(field, text, expected).map(Some),
    };
    let time_expected = "a finite number of seconds from 0 to 9.2e9, or nothing";
    let time = optional("time_s", time_s, time_expected)?;
    if time.is_some_and(|seconds| !(0.0..=MAX_TIME_S).contains(&seconds)) {
        return Err(bad("time_s", time_expected, time_s));
    }
    Ok(Row {
        line,
        index: index.parse().map_err(|_| bad("index", "a whole number from 0 to 4294967295", index))?,
        file: file.into(),
        image: image_path(file).ok_or_else(|| {
            bad("file", "the name of a .jpg file inside images/, such as `0000.jpg` or `images/0000.jpg`", file)
        })?,
        x_m: metres("x_m", x_m)?,
        y_m: metres("y_m", y_m)?,
        yaw_rad: optional("yaw_rad", yaw_rad, "a finite number of radians, or nothing")?,
        time_s: time,
    })
}

/// The path of an image relative to `images/`, or `None` if `file` names nothing inside that folder.
pub(super) fn image_path(file: &str) -> Option<PathBuf> {
    if file.is_empty() || file.contains(['\0', '\n', '\r', '\\']) {
        return None;
    }
    let path = Path::new(file);
    let path = path.strip_prefix(IMAGES_FOLDER).unwrap_or(path);
    let inside = path.components().all(|part| matches!(part, Component::Normal(_)));
    // Collected anew, `a//b` and `a/b` are the same file.
    (inside && path.file_name().is_some()).then(|| path.components().collect())
}

/// Rows are in the order of their index; time must follow it.
pub(super) fn check_times(path: &Path, rows: &[Row]) -> Result<(), DatasetError> {
    let bad = |row: &Row, expected: String| DatasetError::Field {
        path: path.into(),
        line: row.line,
        field: "time_s",
        expected,
        found: row.time_s.map(|time| time.to_string()).unwrap_or_default(),
    };
    for pair in rows.windows(2) {
        let [before, row] = pair else { continue };
        match (before.time_s, row.time_s) {
            (Some(earlier), Some(time)) if time < earlier => {
                let expected =
                    format!("a time not before {earlier}, that of index {} (line {})", before.index, before.line);
                return Err(bad(row, expected));
            }
            (Some(_), None) => return Err(bad(row, format!("a time, as line {} has one", before.line))),
            (None, Some(_)) => return Err(bad(row, format!("nothing, as line {} has no time", before.line))),
            _ => {}
        }
    }
    Ok(())
}

/// Exact duplicates of a position are allowed (the vehicle may stand) but often a mistake.
pub(super) fn duplicate_positions(rows: &[Row]) -> Vec<String> {
    const SHOWN: usize = 5;
    let mut first_line = HashMap::new();
    let mut duplicates = Vec::new();
    for row in rows {
        let key = ((row.x_m + 0.0).to_bits(), (row.y_m + 0.0).to_bits());
        match first_line.get(&key) {
            Some(first) => duplicates.push(format!("{} and {first}", row.line)),
            None => drop(first_line.insert(key, row.line)),
        }
    }
    if duplicates.is_empty() {
        return Vec::new();
    }
    let more = duplicates.len().saturating_sub(SHOWN);
    let more = if more > 0 { format!(", and {more} more") } else { String::new() };
    let shown = duplicates[..duplicates.len().min(SHOWN)].join(", ");
    vec![format!(
        "{POSITIONS_FILE}: {} rows repeat the exact position of another: lines {shown}{more}",
        duplicates.len()
    )]
}

pub(super) fn yaw_in_degrees(rows: &[Row]) -> Option<String> {
    let row = rows.iter().find(|row| row.yaw_rad.is_some_and(|yaw| yaw.abs() > std::f64::consts::TAU))?;
    let yaw = row.yaw_rad.unwrap_or_default();
    Some(format!(
        "{POSITIONS_FILE}, line {}, field `yaw_rad`: {yaw} is more than a full turn; are these degrees?",
        row.line
    ))
}

#[cfg(test)]
mod tests {
    use super::*;

    const HEAD: &str = "index,file,x_m,y_m,yaw_rad,time_s\n";

    fn rows(text: &str) -> Result<Vec<Row>, DatasetError> {
        read_rows(Path::new("positions.csv"), text.as_bytes())
    }

    #[test]
    fn both_ways_to_name_an_image_mean_the_same_file() {
        let rows = rows(&format!("{HEAD}0,0000.jpg,1,2,,\n1,images/0001.jpg,1.5,-2e1,0.01567,3.25\n")).expect("sound");
        assert_eq!(rows[0].image, Path::new("0000.jpg"));
        assert_eq!(rows[1].image, Path::new("0001.jpg"));
        assert_eq!(
            (rows[1].x_m, rows[1].y_m, rows[1].yaw_rad, rows[1].time_s),
            (1.5, -20.0, Some(0.01567), Some(3.25))
        );
        assert_eq!((rows[0].yaw_rad, rows[0].time_s), (None, None));
    }

    #[test]
    fn each_mistake_names_line_field_expected_and_found() {
        let table: [(&str, String, &[&str]); 16] = [
            ("missing column", "index,file,x_m,y_m,yaw_rad\n".into(), &["line 1", "missing time_s"]),
            ("extra column", "index,file,x_m,y_m,yaw_rad,time_s,z\n".into(), &["line 1", "unexpected z"]),
            ("order", "file,index,x_m,y_m,yaw_rad,time_s\n".into(), &["another order"]),
            ("empty file", String::new(), &["missing index"]),
            ("no rows", HEAD.into(), &["no rows"]),
            ("short row", format!("{HEAD}0,a.jpg,1,2,3\n"), &["line 2", "expected 6 fields", "found 5"]),
            ("long row", format!("{HEAD}0,a.jpg,1,2,3,4,5\n"), &["line 2", "found 7"]),
            ("NaN", format!("{HEAD}0,a.jpg,1,2,,\n1,b.jpg,NaN,2,,\n"), &["line 3", "`x_m`", "finite", "`NaN`"]),
            ("infinite", format!("{HEAD}0,a.jpg,1,-inf,,\n"), &["line 2", "`y_m`", "`-inf`"]),
            ("text", format!("{HEAD}0,a.jpg,1,2,east,\n"), &["line 2", "`yaw_rad`", "radians", "`east`"]),
            ("empty", format!("{HEAD}0,a.jpg,,2,,\n"), &["line 2", "`x_m`", "``"]),
            ("index", format!("{HEAD}1.5,a.jpg,1,2,,\n"), &["line 2", "`index`", "`1.5`"]),
            ("duplicate index", format!("{HEAD}0,a.jpg,1,2,,\n0,b.jpg,1,2,,\n"), &["line 3", "`index`", "line 2"]),
            ("duplicate file", format!("{HEAD}0,a.jpg,1,2,,\n1,images/a.jpg,1,2,,\n"), &["line 3", "`file`", "line 2"]),
            ("escape", format!("{HEAD}0,images/../../a.jpg,1,2,,\n"), &["line 2", "`file`", "inside images/"]),
            ("negative time", format!("{HEAD}0,a.jpg,1,2,,-1\n"), &["line 2", "`time_s`", "from 0"]),
        ];
        for (name, text, expected) in table {
            let message = rows(&text).expect_err(name).to_string();
            for part in expected {
                assert!(message.contains(part), "{name}: `{part}` is not in: {message}");
            }
        }
    }

    #[test]
    fn only_names_inside_the_folder_are_images() {
        for bad in ["", "images", "images/", "..", "../a.jpg", "/etc/passwd", "images//../x", "a\\b.jpg", "./../a"] {
            assert_eq!(image_path(bad), None, "{bad}");
        }
        assert_eq!(image_path("images/left/0.jpg"), Some("left/0.jpg".into()));
    }

    #[test]
    fn repeated_positions_are_named_but_allowed() {
        let rows =
            rows(&format!("{HEAD}0,a.jpg,1,2,,\n1,b.jpg,1,2,,\n2,c.jpg,0,0,,\n3,d.jpg,-0,0,,\n")).expect("sound");
        let warnings = duplicate_positions(&rows);
        assert!(warnings[0].contains("2 rows") && warnings[0].contains("3 and 2, 5 and 4"), "{warnings:?}");
    }

    #[test]
    fn time_must_follow_the_index() {
        let check = |text: &str| {
            let mut rows = rows(&format!("{HEAD}{text}")).expect("sound");
            rows.sort_by_key(|row| row.index);
            check_times(Path::new("positions.csv"), &rows)
        };
        assert!(check("1,b.jpg,0,0,,5\n0,a.jpg,0,0,,4\n").is_ok(), "rows may come in any order");
        let message = check("0,a.jpg,0,0,,5\n1,b.jpg,0,0,,4\n").expect_err("goes back").to_string();
        assert!(message.contains("line 3") && message.contains("not before 5"), "{message}");
        assert!(check("0,a.jpg,0,0,,5\n1,b.jpg,0,0,,\n").is_err());
    }
}
