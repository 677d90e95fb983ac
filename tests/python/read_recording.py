"""Reads an imported recording with the PyPI packages mcap and mcap-protobuf-support and compares it with its data set.

Usage: read_recording.py REC.mcap DATASET
"""

import csv
import json
import math
import sys
from pathlib import Path

from mcap.reader import NonSeekingReader, SeekingReader
from mcap_protobuf.decoder import DecoderFactory

SCHEMAS = {
    "/camera/image": "foxglove.CompressedImage",
    "/gnss/fix": "foxglove.LocationFix",
    "/gnss/heading": "omniloc.Heading",
    "/survey/pair": "omniloc.SurveyPair",
    "/survey/pose": "foxglove.PoseInFrame",
}


def main(recording: Path, dataset: Path) -> None:
    with open(dataset / "positions.csv", newline="") as file:
        rows = {int(row["index"]): row for row in csv.DictReader(file)}

    with open(recording, "rb") as file:
        reader = SeekingReader(file, decoder_factories=[DecoderFactory()], validate_crcs=True)
        messages = {topic: [] for topic in SCHEMAS}
        last_log_time = 0
        for schema, channel, message, decoded in reader.iter_decoded_messages():
            assert schema.encoding == "protobuf" and channel.message_encoding == "protobuf"
            assert schema.name == SCHEMAS[channel.topic], (channel.topic, schema.name)
            assert message.log_time >= last_log_time, "log times go back"
            last_log_time = message.log_time
            stamp = decoded.timestamp.seconds * 1_000_000_000 + decoded.timestamp.nanos
            assert stamp == message.publish_time == message.log_time
            messages[channel.topic].append((message, decoded))

        # No data set of ours is stamped before its images: the linear order is that of the file.
        file.seek(0)
        linear = NonSeekingReader(file, validate_crcs=True)
        times = [message.log_time for _, _, message in linear.iter_messages(log_time_order=False)]
        assert times == sorted(times), "log times in the file go back"

        attachments = {attachment.name: attachment.data for attachment in reader.iter_attachments()}
        metadata = {record.name: record.metadata for record in reader.iter_metadata()}
        summary = reader.get_summary()

    assert summary.statistics.message_count == sum(map(len, messages.values()))
    assert summary.statistics.chunk_count == len(summary.chunk_indexes) > 0
    assert attachments["donut.json"] == (dataset / "donut.json").read_bytes()
    json.loads(attachments["donut.json"])
    assert metadata["source"]["name"] == dataset.name and "version" in metadata["program"]

    assert [message.sequence for message, _ in messages["/camera/image"]] == sorted(rows)
    for message, image in messages["/camera/image"]:
        name = rows[message.sequence]["file"].removeprefix("images/")
        assert image.data == (dataset / "images" / name).read_bytes(), name
        assert image.format == "jpeg"

    assert len(messages["/survey/pair"]) == len(messages["/survey/pose"]) == len(rows)
    for (_, pair), (_, pose) in zip(messages["/survey/pair"], messages["/survey/pose"]):
        row = rows[pair.frame_sequence]
        assert (pair.east_m, pair.north_m) == (float(row["x_m"]), float(row["y_m"])), row
        assert pair.valid and pair.source_file == row["file"]
        assert pair.HasField("yaw_rad") == bool(row["yaw_rad"])
        assert not pair.HasField("interpolation_gap_s") and not pair.HasField("serial_latency_s")
        assert pose.frame_id == "map"
        assert (pose.pose.position.x, pose.pose.position.y) == (pair.east_m, pair.north_m)
        if row["yaw_rad"]:
            assert pair.yaw_rad == float(row["yaw_rad"])
            q = pose.pose.orientation
            assert math.isclose(math.remainder(2 * math.atan2(q.z, q.w) - pair.yaw_rad, math.tau), 0, abs_tol=1e-12)
        if row["time_s"]:
            assert pair.dataset_time_s == float(row["time_s"])

    assert len(messages["/gnss/heading"]) == sum(1 for row in rows.values() if row["yaw_rad"])
    assert all(heading.source == "dataset" for _, heading in messages["/gnss/heading"])
    if "origin" in metadata:
        assert len(messages["/gnss/fix"]) == len(rows)
        latitude = float(metadata["origin"]["latitude_deg"])
        assert abs(messages["/gnss/fix"][0][1].latitude - latitude) < 0.01
    else:
        assert not messages["/gnss/fix"]
    print(f"{recording}: {len(rows)} frames as in {dataset}")


if __name__ == "__main__":
    main(Path(sys.argv[1]), Path(sys.argv[2]))
