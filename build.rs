//! Compiles `proto/` without protoc: Rust types for prost, and for each message that has a topic the descriptor set that
//! goes into recordings as its schema.

use std::{env, error::Error, fs, path::PathBuf};

use prost::Message;
use protox::Compiler;

/// Messages that are written to a topic; what they import comes along.
const TOPIC_MESSAGES: [&str; 11] = [
    "foxglove/CompressedImage",
    "foxglove/LocationFix",
    "foxglove/PoseInFrame",
    "omniloc/ClockOffset",
    "omniloc/Dropped",
    "omniloc/Heading",
    "omniloc/PositionEstimate",
    "omniloc/Pulse",
    "omniloc/SerialChunk",
    "omniloc/Status",
    "omniloc/SurveyPair",
];

fn main() -> Result<(), Box<dyn Error>> {
    println!("cargo::rerun-if-changed=proto");
    let out_dir = PathBuf::from(env::var("OUT_DIR")?);

    for message in TOPIC_MESSAGES {
        let mut compiler = Compiler::new(["proto"])?;
        compiler.include_imports(true).include_source_info(false).open_file(format!("{message}.proto"))?;
        let schema = compiler.file_descriptor_set().encode_to_vec();
        fs::write(out_dir.join(format!("{}.fds", message.replace('/', "."))), schema)?;
    }

    let files = TOPIC_MESSAGES.map(|message| format!("{message}.proto"));
    prost_build::Config::new().include_file("proto.rs").compile_fds(protox::compile(files, ["proto"])?)?;
    Ok(())
}
