"""Reads a drive that `record` made with the PyPI packages mcap and mcap-protobuf-support.

Usage: read_drive.py REC.mcap
"""

import json
import math
import sys
from pathlib import Path

from mcap.reader import SeekingReader
from mcap_protobuf.decoder import DecoderFactory

SCHEMAS = {
    "/camera/image": "foxglove.CompressedImage",
    "/gnss/raw": "omniloc.SerialChunk",
    "/gnss/fix": "foxglove.LocationFix",
    "/gnss/heading": "omniloc.Heading",
    "/gnss/pulse": "omniloc.Pulse",
    "/survey/pair": "omniloc.SurveyPair",
    "/survey/pose": "foxglove.PoseInFrame",
    "/clock": "omniloc.ClockOffset",
    "/status": "omniloc.Status",
    "/dropped": "omniloc.Dropped",
}


def main(recording: Path) -> None:
    with open(recording, "rb") as file:
        reader = SeekingReader(file, decoder_factories=[DecoderFactory()], validate_crcs=True)
        metadata = {record.name: record.metadata for record in reader.iter_metadata()}
        offset = int(metadata["clock"]["log_offset_ns"])
        messages = {topic: [] for topic in SCHEMAS}
        for schema, channel, message, decoded in reader.iter_decoded_messages():
            assert schema.name == SCHEMAS[channel.topic], (channel.topic, schema.name)
            stamp = decoded.timestamp.seconds * 1_000_000_000 + decoded.timestamp.nanos
            assert stamp == message.log_time == message.publish_time + offset, channel.topic
            messages[channel.topic].append((message, decoded))
        attachments = {attachment.name: attachment.data for attachment in reader.iter_attachments()}
        summary = reader.get_summary()

    assert summary.statistics.message_count == sum(map(len, messages.values()))
    assert set(json.loads(attachments["donut.json"])) >= {"cx", "cy", "r_in", "r_out"}
    assert "[recorder]" in metadata["settings"]["toml"] and "latitude_deg" in metadata["origin"]

    images = {message.sequence: message.publish_time for message, _ in messages["/camera/image"]}
    assert len(images) == len(messages["/camera/image"]), "frame numbers repeat"
    assert all(image.data[:2] == b"\xff\xd8" and image.format == "jpeg" for _, image in messages["/camera/image"])
    pairs = {message.sequence: pair for message, pair in messages["/survey/pair"]}
    assert pairs.keys() == images.keys(), "a pair for every frame"
    valid = {sequence: pair for sequence, pair in pairs.items() if pair.valid}
    assert all(pair.invalid_reason for pair in pairs.values() if not pair.valid)
    poses = {message.publish_time: pose for message, pose in messages["/survey/pose"]}
    assert poses.keys() == {images[sequence] for sequence in valid}
    for sequence, pair in valid.items():
        position = poses[images[sequence]].pose.position
        assert math.dist((position.x, position.y), (pair.east_m, pair.north_m)) == 0
        assert 0 < pair.interpolation_gap_s <= 0.6
    print(f"{len(images)} frames, {len(valid)} usable")


if __name__ == "__main__":
    main(Path(sys.argv[1]))
