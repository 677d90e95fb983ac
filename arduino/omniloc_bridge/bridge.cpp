#include "bridge.h"

#include "board.h"

static const uint16_t TICKS_PER_MS = 10;
static const uint16_t ATTITUDE_PERIOD_TICKS = 100;
static const uint16_t POSITION_PERIOD_TICKS = 1000;
static const int32_t EARLY_TICKS = 25;
static const uint16_t HEARTBEAT_MS = 1000;

// What status, receiver and height said is taken for later packets up to this age: the receiver speaks four times a
// second.
static const uint16_t MAX_AGE_MS = 1500;
// Positions come at 10 Hz while there are any.
static const uint16_t NO_PLACE_MS = 500;

// What a line leaves free of the queue. When more is to be sent than the line to the computer carries, attitudes go
// first, then positions; there is always room for a heartbeat.
static const uint16_t KEEP_FREE_OF_ATTITUDES = 448;
static const uint16_t KEEP_FREE_OF_POSITIONS = 240;
static const uint16_t KEEP_FREE_OF_HEARTBEATS = 0;

bool Pace::is_due(uint32_t ticks) {
    int32_t late_ticks = (int32_t)(ticks - next_ticks_);
    int32_t period_ticks = period_ticks_;
    // Samples that are a little early are not left out; those that are much too early are of a clock that was reset.
    if (has_started_ && late_ticks < -EARLY_TICKS && late_ticks >= -2 * period_ticks) {
        return false;
    }
    bool is_in_step = has_started_ && late_ticks < period_ticks && late_ticks >= -period_ticks;
    next_ticks_ = (is_in_step ? next_ticks_ : ticks) + period_ticks_;
    has_started_ = true;
    return true;
}

Bridge::Bridge() : attitude_pace_(ATTITUDE_PERIOD_TICKS), position_pace_(POSITION_PERIOD_TICKS) {}

static bool is_recent(bool has_value, uint32_t value_ms, uint32_t now_ms) {
    return has_value && now_ms - value_ms <= MAX_AGE_MS;
}

bool Bridge::send(Line &line, uint16_t keep_free) {
    line.finish();
    bool is_sent = board_send_line(line.bytes(), line.length(), keep_free);
    dropped_lines_ += !is_sent;
    return is_sent;
}

void Bridge::poll(uint32_t now_ms) {
    Packet packet;
    if (framer_.next(packet)) {
        Said said;
        if (packet.message != MTDATA2) {
            device_.message(packet, now_ms);
        } else if (parse_measurement(packet.data, packet.size, said)) {
            ++packets_;
            refused_ += said.is_refused && refused_ != UINT16_MAX;
            device_.measured(now_ms);
            measurement(said, now_ms);
        } else {
            framer_.reject();
        }
    }
    device_.poll(now_ms);
    if (!has_beaten_ || now_ms - beat_ms_ >= HEARTBEAT_MS) {
        beat_ms_ = has_beaten_ ? beat_ms_ + HEARTBEAT_MS : now_ms;
        has_beaten_ = true;
        heartbeat(now_ms);
        ++uptime_s_;
    }
}

bool Bridge::is_measuring(uint32_t now_ms) const { return is_recent(has_status_, status_ms_, now_ms); }

bool Bridge::has_fix(uint32_t now_ms) const { return is_measuring(now_ms) && quality(now_ms) != NO_FIX; }

void Bridge::measurement(const Said &said, uint32_t now_ms) {
    remember(said, now_ms);
    SampleTime time = sample_time(said);
    uint32_t ticks = said.has_ticks ? said.ticks : now_ms * TICKS_PER_MS;
    date(said, time);
    position(said, time, ticks, now_ms);
    if (said.has_attitude && attitude_pace_.is_due(ticks)) {
        attitude(said, time, now_ms);
    }
}

void Bridge::remember(const Said &said, uint32_t now_ms) {
    if (said.has_counter) {
        uint16_t missed = said.counter - counter_ - 1;
        // Backwards: the sensor was switched off and on.
        missed_packets_ += has_counter_ && missed < 0x8000 ? missed : 0;
        counter_ = said.counter;
        has_counter_ = true;
    }
    if (said.has_status) {
        status_ = said.status;
        status_ms_ = now_ms;
        has_status_ = true;
    }
    if (said.has_height) {
        height_cm_ = said.height_cm;
        height_ms_ = now_ms;
        has_height_ = true;
    }
    if (said.has_receiver) {
        if (!is_recent(has_receiver_, receiver_ms_, now_ms)) {
            receiver_ = ReceiverSaid();
        }
        receiver_ms_ = now_ms;
        has_receiver_ = true;
        remember_receiver(said.receiver);
    }
}

// The old firmware spreads it over two items, which need not come in the same packet.
void Bridge::remember_receiver(const ReceiverSaid &said) {
    if (said.has_satellites) {
        receiver_.satellites = said.satellites;
        receiver_.has_satellites = true;
        receiver_.is_differential = said.is_differential;
        receiver_.has_std = said.has_std;
        for (uint8_t i = 0; i < 3; ++i) {
            receiver_.std_mm[i] = said.std_mm[i];
        }
        receiver_.has_accuracy = said.has_accuracy;
        receiver_.accuracy_mm = said.accuracy_mm;
    }
    if (said.has_horizontal_dilution) {
        receiver_.has_horizontal_dilution = true;
        receiver_.horizontal_dilution_centi = said.horizontal_dilution_centi;
    }
    if (said.has_dilutions) {
        receiver_.has_dilutions = true;
        for (uint8_t i = 0; i < 4; ++i) {
            receiver_.dilution_centi[i] = said.dilution_centi[i];
        }
    }
    if (receiver_.has_accuracy && receiver_.has_dilutions) {
        receiver_.has_std = true;
        for (uint8_t i = 0; i < 3; ++i) {
            uint64_t product = (uint64_t)receiver_.accuracy_mm * receiver_.dilution_centi[i];
            receiver_.std_mm[i] = product / receiver_.dilution_centi[3];
        }
    }
}

// A sensor that sends no status is believed.
Quality Bridge::quality(uint32_t now_ms) const {
    const uint8_t COASTING = 1;
    bool is_differential = is_recent(has_receiver_, receiver_ms_, now_ms) && receiver_.is_differential;
    Quality fix = is_differential ? DIFFERENTIAL : AUTONOMOUS;
    if (!is_recent(has_status_, status_ms_, now_ms)) {
        return fix;
    }
    if (!(status_ & STATUS_FILTER_VALID)) {
        return NO_FIX;
    }
    if (status_ & STATUS_GNSS_FIX) {
        return fix;
    }
    return filter_mode(status_) == COASTING ? DEAD_RECKONING : NO_FIX;
}

// Once a second, with the first packet of it.
void Bridge::date(const Said &said, const SampleTime &time) {
    if (!time.is_known || time.is_next_day || said.utc.second == date_second_) {
        return;
    }
    date_second_ = said.utc.second;
    Line line("$GNZDA");
    write_date(line, time, said.utc);
    send(line, KEEP_FREE_OF_POSITIONS);
}

void Bridge::position(const Said &said, const SampleTime &time, uint32_t ticks, uint32_t now_ms) {
    Quality quality = this->quality(now_ms);
    if (said.has_place) {
        place_ms_ = now_ms;
        has_place_ = true;
    } else if (quality != NO_FIX || (has_place_ && now_ms - place_ms_ <= NO_PLACE_MS)) {
        return;
    }
    if (!position_pace_.is_due(ticks)) {
        return;
    }
    if (quality == NO_FIX) {
        ++no_fixes_;
        Line line("$GNGGA");
        write_no_position(line, time);
        send(line, KEEP_FREE_OF_POSITIONS);
        return;
    }
    ReceiverSaid receiver = is_recent(has_receiver_, receiver_ms_, now_ms) ? receiver_ : ReceiverSaid();
    const uint32_t MAX_STD_MM = 100000000;
    if (receiver.has_std && receiver.std_mm[0] <= MAX_STD_MM && receiver.std_mm[1] <= MAX_STD_MM &&
        receiver.std_mm[2] <= MAX_STD_MM) {
        Line line("$GNGST");
        write_deviation(line, time, receiver.std_mm);
        send(line, KEEP_FREE_OF_POSITIONS);
    }
    Line line("$GNGGA");
    bool has_height = is_recent(has_height_, height_ms_, now_ms);
    write_position(line, time, said, quality, receiver, has_height ? &height_cm_ : 0);
    positions_ += send(line, KEEP_FREE_OF_POSITIONS);
}

void Bridge::attitude(const Said &said, const SampleTime &time, uint32_t now_ms) {
    bool has_position = quality(now_ms) != NO_FIX;
    Heading heading = TRUE_NORTH;
    if (is_recent(has_status_, status_ms_, now_ms) && !has_position) {
        // Without satellites for longer than it can coast the compass is what is left.
        heading = status_ & STATUS_FILTER_VALID ? MAGNETIC_NORTH : UNKNOWN;
    }
    Line line("$PASHR");
    write_attitude(line, time, said, heading, has_position);
    bool is_sent = send(line, KEEP_FREE_OF_ATTITUDES);
    headings_ += is_sent && heading != UNKNOWN;
    if (is_sent && heading == MAGNETIC_NORTH) {
        // It states no time: that of the line before it counts.
        Line magnetic("$HCHDM");
        write_magnetic_heading(magnetic, said);
        send(magnetic, KEEP_FREE_OF_ATTITUDES - 64);
    }
}

void Bridge::heartbeat(uint32_t now_ms) {
    BoardCounters board = board_counters();
    Line health("$POMNH,1");
    health.field(uptime_s_);
    health.character(',');
    health.character(device_.state(now_ms));
    health.field(packets_);
    health.field(positions_);
    health.field(headings_);
    health.field(no_fixes_);
    health.field(board.pulses);
    health.field(board.pulse_interval_us);
    send(health, KEEP_FREE_OF_HEARTBEATS);

    Line errors("$POMNE,1");
    errors.field(framer_.wrong_sums);
    errors.field(framer_.skipped_bytes);
    errors.field(board.overruns);
    errors.field(board.framing_errors);
    errors.field(dropped_lines_);
    errors.field(missed_packets_);
    errors.field(refused_);
    errors.field(device_.losses);
    errors.field(board.peak_waiting);
    send(errors, KEEP_FREE_OF_HEARTBEATS);
}
