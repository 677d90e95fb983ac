#!/usr/bin/env python3
"""Writes the .bin files of this folder: an implementation of the formats that shares nothing with the program's.

    python3 tests/serial_corpus/make.py
    OMNILOC_BLESS=1 cargo test --test serial_corpus    # then read what changed in the .expected files

A name may end with @BAUD: the speed that the bytes are given to the decoder with, 100000 otherwise. At 1000 baud a
sentence takes most of a second, so that a stream can last long enough for jumps to be judged.
"""

import math
import pathlib
import random
import struct

HERE = pathlib.Path(__file__).parent
streams = {}


def stream(name, *parts):
    number = len(streams) + 1
    data = b"".join(part.encode("latin-1") if isinstance(part, str) else part for part in parts)
    streams[f"{number:03}-{name}"] = data


def nmea(content, end="\r\n", sum_format="{:02X}"):
    total = 0
    for byte in content.encode("latin-1"):
        total ^= byte
    return f"${content}*{sum_format.format(total)}{end}"


def lines(*contents):
    return "".join(nmea(content) for content in contents)


def gga(time, lat="4722.613160,N", lon="00832.501200,E", quality=1, talker="GN", rest="09,0.9,455.2,M,0.0,M,,"):
    return f"{talker}GGA,{time},{lat},{lon},{quality},{rest}"


def rmc(time, date="221126", lat="4722.613160,N", lon="00832.501200,E", speed="19.4384", course="90.0", status="A"):
    return f"GPRMC,{time},{status},{lat},{lon},{speed},{course},{date},,,{'A' if status == 'A' else 'N'}"


def north_of(metres):
    """A latitude this far north of the usual one."""
    return f"{4722.613160 + metres / 1852:.6f},N"


# Xbus

def packet(data, mid=0x36, extended=False):
    if len(data) > 254 or extended:
        head = struct.pack("!BBBH", 0xFF, mid, 0xFF, len(data))
    else:
        head = struct.pack("!BBB", 0xFF, mid, len(data))
    body = head + data
    return b"\xfa" + body + bytes([-sum(body) & 0xFF])


def item(ident, content):
    return struct.pack("!HB", ident, len(content)) + content


def real(value, precision):
    if precision == 0:
        return struct.pack("!f", value)
    if precision == 1:
        return struct.pack("!i", round(value * 2**20))
    if precision == 2:
        fixed = round(value * 2**32)
        return struct.pack("!Ih", fixed & 0xFFFFFFFF, fixed >> 32)
    return struct.pack("!d", value)


def reals(values, precision=0):
    return b"".join(real(value, precision) for value in values)


def utc(year=2026, month=11, day=22, hour=8, minute=15, second=30, ns=0, flags=7):
    return item(0x1010, struct.pack("!IHBBBBBB", ns, year, month, day, hour, minute, second, flags))


def counter(value):
    return item(0x1020, struct.pack("!H", value))


def fine(ticks):
    return item(0x1060, struct.pack("!I", ticks & 0xFFFFFFFF))


def euler(yaw, precision=0, frame=0, roll=1.0, pitch=-2.0):
    return item(0x2030 | frame | precision, reals([roll, pitch, yaw], precision))


def place(precision=3, lat=47.376886, lon=8.541687, altitude=455.2):
    return item(0x5020 | precision, reals([altitude], precision)) + item(0x5040 | precision, reals([lat, lon], precision))


def velocity(x, y, z, precision=0, frame=0):
    return item(0xD010 | frame | precision, reals([x, y, z], precision))


def status(word=0x01800047):
    return item(0xE020, struct.pack("!I", word))


def pvt(fix=3, flags=1, lat=47.376886, lon=8.541687):
    fields = [0, 2026, 11, 22, 8, 15, 30, 7, 50, 0, fix, flags, 11, 0, round(lon * 1e7), round(lat * 1e7), 455200,
              407200, 1414, 2500, 0, 10000, 0, 10000, 9000000, 300, 100000, 0, 150, 130, 100, 90, 80, 70, 60]
    return item(0x7010, struct.pack("!IHBBBBBBIiBBBBiiiiIIiiiiiIIiHHHHHHH", *fields))


NED, NWU = 4, 8

# The Arduino's lines (docs/arduino-lines.md)


def arduino(ticks, start_ms=29730000):
    out = []
    for tick in ticks:
        ms = start_ms + 10 * tick
        time = f"{ms // 3600000:02}{ms // 60000 % 60:02}{ms // 1000 % 60:02}.{ms % 1000:03}"
        if tick % 100 == 0:
            out.append(f"GNZDA,{time},22,11,2026,00,00")
        if tick % 10 == 0:
            out.append(f"GNGST,{time},,,,,1.100,0.900,2.500")
            out.append(gga(time, lat=north_of(tick * 0.1)))
        out.append(f"PASHR,{time},{42.75 + 0.04 * tick:.3f},T,-0.35,1.20,,0.50,0.50,0.800,1")
    return lines(*out)


def uart(data, sent_baud, read_baud, oversampling=16):
    """What a receiver at another rate makes of bytes sent back to back; bytes with a low stop bit are dropped."""
    bits = []
    for byte in data.encode("latin-1"):
        bits += [0] + [byte >> i & 1 for i in range(8)] + [1]

    def level(time):
        index = int(time * sent_baud)
        return bits[index] if index < len(bits) else 1

    out, time, end, bit = bytearray(), 0.0, len(bits) / sent_baud, 1 / read_baud
    while time < end:
        if level(time):
            time += bit / oversampling
            continue
        byte = sum(level(time + (1.5 + i) * bit) << i for i in range(8))
        time += 9.5 * bit
        if level(time):
            out.append(byte)
        else:
            while time < end and not level(time):
                time += bit / oversampling
    return bytes(out)


# --- NMEA: who talks and what
stream("arduino", arduino(range(0, 21)))
stream("ublox-1hz", lines(
    rmc("081530.00"), "GPVTG,90.0,T,,M,19.4384,N,36.000,K,A", gga("081530.00", talker="GP", rest="08,1.01,407.2,M,48.0,M,,"),
    "GPGSA,A,3,10,07,05,02,29,04,08,13,,,,,1.72,1.03,1.38", "GPGSV,1,1,04,07,79,048,42,02,51,062,43,26,36,256,42,27,27,138,42",
    "GPGLL,4722.613160,N,00832.501200,E,081530.00,A,A", "GPTXT,01,01,02,u-blox ag - www.u-blox.com"))
stream("gn-all-position-sentences", lines(
    "GNRMC,081530.00,A,4722.613160,N,00832.501200,E,19.4384,90.0,221126,,,D,V",
    "GNGNS,081530.00,4722.613160,N,00832.501200,E,DDNN,12,0.8,407.2,48.0,1.0,0138,V",
    gga("081530.00", quality=2, rest="12,0.8,407.2,M,48.0,M,1.0,0138"), "GNGST,081530.00,12,1.5,0.9,45.0,1.1,0.9,2.5"))
stream("glonass-only", lines(gga("081530", talker="GL", rest="06,2.1,407.2,M,48.0,M,,")))
stream("he-hdt-after-gga", lines(gga("081530.00"), "HEHDT,42.8,T", "HEROT,-3.2,A", "HEHDT,42.9,T"))
stream("hc-hdm-only", lines("HCHDM,40.1,M", "HCHDM,40.2,M"))
stream("hc-hdg-deviation-variation", lines("HCHDG,101.1,,,7.1,W", "HCHDG,101.1,1.5,E,7.1,W", "HCHDG,101.1,1.5,W,,"))
stream("in-integrated", lines("INZDA,081530.00,22,11,2026,,", gga("081530.00", talker="IN"), "INHDT,42.75,T", "INVTG,42.7,T,,M,10.0,N,18.5,K"))
stream("xsens-strings", lines("HCHDM,340.5,M", "HCHDG,340.5,0.0,E,2.1,E", "PHTRO,10.37,P,177.62,T", "HCMTW,27.3,C", "HEHDT,342.6,T", "HEROT,0.0,T",
       "PSONCMS,0.0905,0.4217,0.9020,-0.0196,-1.7685,0.3861,-9.6648,-0.0116,0.0065,-0.0080,0.0581,0.3846,-0.2216,31.3"))
stream("prdid-with-and-without-sum", "$PRDID,-10.37,2.34,197.62\r\n", lines("PRDID,-10.37,2.34,197.62"))
stream("pashr-inertial", lines("PASHR,081530.00,312.27,T,-0.30,-0.37,-0.01,0.029,0.029,0.042,1,0", "PASHR,081530.01,312.31,T,-0.30,-0.37,-0.01,0.029,0.029,0.042,2,1"))
stream("pashr-other-kinds", lines("PASHR,POS,0,06,081530.00,4722.6,N", "PASHR,SAT,04,03,103,56,60,U"))
stream("pashr-empty-heading", lines("PASHR,081530.00,,T,,,,,,,0", "PASHR,,42.750,T,-0.35,1.20,,0.50,0.50,0.800,0"))
stream("rmc-only", lines(rmc("081530.00"), rmc("081531.00", lat=north_of(5))))
stream("rmc-void-then-valid", lines("GPRMC,081529.00,V,,,,,,,221126,,,N", rmc("081530.00")))
stream("gga-no-fix-then-fix", lines("GPGGA,,,,,,0,00,99.99,,,,,,", "GPGGA,081529.00,,,,,0,00,99.99,,M,,M,,", gga("081530.00")))
stream("empty-fields", lines("GPGGA,,,,,,,,,,,,,,", "GPRMC,,V,,,,,,,,,,N", "GNGNS,,,,,,NN,,,,,,,", "GPGST,,,,,,,,", "GPZDA,,,,,,", "HEHDT,,T", "HCHDM,,M", "HCHDG,,,,,", "GPVTG,,,,,,,,,N", "PASHR,,,,,,,,,,"))
stream("gga-without-height", lines(gga("081530.00", rest="05,3.0,,M,,M,,")))
stream("south-west-santiago", lines(gga("081530.00", lat="3326.934000,S", lon="07039.636000,W")))
stream("south-east-sydney", lines(gga("081530.00", lat="3352.128000,S", lon="15112.558000,E")))
stream("date-line-crossed", lines(gga("081530.00", lat="1633.000000,S", lon="17959.999500,E"), gga("081531.00", lat="1633.000000,S", lon="17959.999500,W")))
stream("equator-crossed", lines(gga("081530.00", lat="0000.000000,N", lon="00832.501200,E"), gga("081531.00", lat="0000.003000,S", lon="00832.501200,E")))
stream("null-island", lines(gga("081530.00", lat="0000.000000,N", lon="00000.000000,E")))
stream("near-the-pole", lines(gga("081530.00", lat="8959.990000,N", lon="00832.501200,E")))
stream("midnight-without-date", lines(gga("235959.90"), gga("000000.00"), gga("000000.10")))
stream("midnight-with-date", lines(rmc("235959.90", date="311226"), gga("235959.90"), gga("000000.00"), rmc("000000.00", date="010127"), gga("000000.10")))
stream("leap-second", lines("GPZDA,235959.50,31,12,2026,00,00", gga("235960.00"), gga("235960.50"), gga("000000.00"), gga("120060.00")))
stream("date-before-2020", lines("GPZDA,081530.00,06,01,1980,00,00", rmc("081530.00", date="080407"), gga("081530.00")))
stream("date-after-2080", lines(rmc("081530.00", date="010181"), gga("081530.00")))
stream("date-that-is-none", lines("GPZDA,081530.00,31,02,2026,00,00", rmc("081530.00", date="320126")))
stream("gns-six-constellations", lines("GNGNS,081530.00,4722.613160,N,00832.501200,E,ANNNNN,07,1.1,407.2,48.0,,,V", "GNGNS,081531.00,4722.613160,N,00832.501200,E,NNNNNN,00,99.9,,,,,V"))
stream("rtk", lines(gga("081530.00", quality=5), gga("081531.00", quality=4), "GNGNS,081532.00,4722.6,N,00832.5,E,RRNN,12,0.8,407.2,48.0,1.0,0138,V"))
stream("dead-reckoning-and-simulated", lines(gga("081530.00", quality=6), gga("081531.00", quality=8), gga("081532.00", quality=7)))
stream("gst-before-after-and-old@1000", lines("GPGST,081530.00,,,,,1.1,0.9,2.5", gga("081530.00"), gga("081532.00"), "GPGST,081533.00,,,,,0.0,0.0,0.0", gga("081533.00")))
stream("vtg-gives-speed", lines("GPVTG,54.7,T,34.4,M,5.5,N,10.2,K", gga("081530.00"), "GPVTG,,T,,M,0.00,N,0.00,K", gga("081531.00")))

# --- NMEA: framing
stream("lf-only", nmea(gga("081530.00"), end="\n"), nmea("HEHDT,42.8,T", end="\n"))
stream("cr-only", nmea(gga("081530.00"), end="\r"), nmea("HEHDT,42.8,T"))
stream("lower-case-sum", nmea(gga("081530.10"), sum_format="{:02x}"), nmea(gga("081530.20"), sum_format="{:02x}"))
stream("missing-sums", "$GPGGA,081530.00,4722.613160,N,00832.501200,E,1,09,0.9,455.2,M,0.0,M,,\r\n", "$HEHDT,42.8,T\r\n", "$HEHDT,42.8,T*\r\n", "$HEHDT,42.8,T*2\r\n", lines("HEHDT,42.8,T"))
stream("wrong-sums", nmea(gga("081530.00")).replace("4722", "4723"), nmea("HEHDT,42.8,T").replace("42.8", "43.8"), lines("HEHDT,42.8,T"))
stream("one-bit-error-a-line", *[bytes(b ^ (1 << (i % 7) if at == 12 + i else 0) for at, b in enumerate(nmea("HEHDT,42.8,T").encode() + nmea(gga("081530.00")).encode())) for i in range(12)])
stream("overlong-line", nmea("GPTXT," + "x" * 300), lines("HEHDT,42.8,T"), nmea("GPTXT," + "y" * 240), lines("HEHDT,42.9,T"))
stream("cut-at-the-start", nmea(gga("081530.00"))[31:], lines("HEHDT,42.8,T"))
stream("cut-at-the-end", lines("HEHDT,42.8,T"), nmea(gga("081530.00"))[:40])
stream("merged-sentences", nmea(gga("081530.00"))[:37], nmea("HEHDT,42.8,T"), nmea("HEHDT,42.9,T")[:-2], nmea("HEHDT,43.0,T"))
stream("bytes-lost-in-the-middle", nmea(gga("081530.00"))[:30], nmea(gga("081530.00"))[45:], lines("HEHDT,42.8,T"))
stream("flood-of-ff", b"\xff" * 700, lines("HEHDT,42.8,T"), b"\xff" * 300)
stream("flood-of-00", b"\x00" * 700, lines("HEHDT,42.8,T"), b"\x00" * 300)
stream("flood-of-dollars-and-preambles", b"$" * 300, b"\xfa\xff" * 300, lines("HEHDT,42.8,T"), b"\xfa" * 300, lines("HEHDT,42.9,T"))
stream("not-printable-within", nmea("HEHDT,4\x002.8,T"), nmea("HEHDT,\xe942.8,T"), nmea("HEHDT,\t42.8,T"), lines("HEHDT,42.8,T"))
stream("impossible-values", lines(gga("081530.00", lat="9930.0,N"), gga("081530.00", lat="4775.0,N"), gga("256199.00"), gga("081530.00", lon="18100.0,E"), gga("081530.00", lat="4722.6,E"), gga("081530.00", rest="09,0.9,nan,M,0.0,M,,"), "HEHDT,400.0,T", "HEHDT,nan,T", "PASHR,081530.00,42.0,M,,,,,,,1", "GPVTG,54.7,T,34.4,M,99999,N,10.2,K"))
stream("gpsd-like-log", "# Name: some receiver\r\n# Date: 2026-11-22\r\n", lines("PUBX,00,081530.00,4722.613160,N,00832.501200,E,546.589,G3,2.1,2.0,0.007,77.52,0.007,,0.92,1.19,0.77,9,0,0", "PMTK010,001",
       gga("081530.000", talker="GP", rest="9,0.90,407.2,M,48.0,M,,0000"), "GPGBS,081530.00,1.6,1.4,3.2,,,,", "PGRME,15.0,M,45.0,M,25.0,M", "PSRFTXT,Version 3.5.0"), "!AIVDM,1,1,,A,15RTgt0PAso;90TKcjM8h6g208CQ,0*4A\r\n", "\r\n\r\n")
stream("other-talkers", lines(gga("081530.00", talker="GA"), gga("081530.10", talker="BD"), gga("081530.20", talker="QZ"), "YXXDR,A,1.0,D,PITCH", "TIROT,1.0,A"))

# --- plausibility
stream("jump-and-back@1000", lines(gga("081530.00"), gga("081531.00", lat=north_of(5000)), gga("081532.00", lat=north_of(10))))
stream("new-place-believed@1000", lines(gga("081530.00"), *[gga(f"0815{31 + i}.00", lat=north_of(5000 + 10 * i)) for i in range(7)]))
stream("tunnel@1000", lines(gga("081530.00")), "x" * 3000, lines(gga("081600.00", lat=north_of(900))))
stream("too-fast", lines(rmc("081530.00", speed="140.0"), rmc("081531.00", speed="100.0")))

# --- wrong rates
garbled = arduino(range(0, 3))
stream("sent-at-115200-read-at-57600", uart(garbled, 115200, 57600), lines("HEHDT,42.8,T"))
stream("sent-at-115200-read-at-9600", uart(garbled, 115200, 9600), lines("HEHDT,42.8,T"))
stream("sent-at-9600-read-at-115200", uart(garbled, 9600, 115200), lines("HEHDT,42.8,T"))
stream("sent-at-38400-read-at-57600", uart(garbled, 38400, 57600), lines("HEHDT,42.8,T"))

# --- Xbus: formats
# github.com/einride/xsens-go (MIT), decodeData_test.go: an MTi with GNSS in Gothenburg; the same file says what it means.
EINRIDE = bytes.fromhex("""
10100c29fac3e007e208090d3b04f710200243802033183fb6812e6000000040153a6080000000c0064185a0000000401318bf82880f2000000
03f28adfa000000003fb90df2400000004023 18bfecf442800000003f933e01c0000000402392e5e00000004033183f489e3f000000003f71fa9d
c00000003f8bcaa00000000050230840598f1d5d2d99f1504310404cd86b0b41659c4027f1fe35ec57b8802318bf40a04be0000001bf3b06bf0
00000003f55729e800000008033203ff0000000000001bec5480f00000000bec14bff400000003edb73fde0000000c023183fc86a38e00000003fd4
09f680000000bff34d1da0000000d013183fb29903c00000003f8731dc400000003f92861580000000e0200401800047""".replace("\n", "").replace(" ", ""))
stream("xbus-real-mti-gnss-2018", packet(EINRIDE))
# github.com/Scottapotamas/xsens-mti, docs/mtmanager_packets.md: an MTi-300 (no GNSS), examples 6 and 1.
stream("xbus-real-mti-300", packet(bytes.fromhex("10200246821060 0401C4FC3E2010103F71CE6CBEA56BCF3C613BD8BD691D25E02004004 00003".replace(" ", ""))),
       packet(bytes.fromhex("102002A6551060040057472E2010103F7F7DC4BC10107D3BA15770BD7EC65640200CBDA21AF8BE2A8E96411D27A240100CB94FC800B9DA24003CC9"
                            "288040300C3C02C89C3C35F6C83CDB0C0080200CBBB17D81BB9632003C01E841803010 3F800000B6E33001B6C0400037264800C0200CBE999C243F"
                            "B61B563F166AEB301004000186DEE02004 00400003".replace(" ", ""))))
# The values that the example of crate xsens-mti (github.com/jonlamb-gh/xsens-mti) prints for a real packet of 158 bytes.
stream("xbus-158-bytes", packet(utc(2021, 5, 13, 12, 5, 37, 450000000) + counter(48834) + fine(24455074) + item(0x1070, struct.pack("!I", 2445))
       + item(0x2034, reals([-179.259, -0.636, -98.770])) + item(0x4020, reals([-0.076, 0.141, 9.832])) + item(0x5023, reals([603.645], 3))
       + item(0x5033, reals([-1963779.710, -3828825.125, 4692929.349], 3)) + item(0x5043, reals([47.673, -117.153], 3)) + item(0x8020, reals([-0.006, 0.008, 0.005]))
       + item(0xD010, reals([-0.141, -0.015, 0.032])) + item(0xE020, struct.pack("!I", 0x01800047))))
everything = [("f64-enu", 3, 0, 47.25, (10.0, 1.0, 0.1)), ("fp1632-ned", 2, NED, 42.75, (1.0, 10.0, -0.1)), ("fp1220-nwu", 1, NWU, -42.75, (1.0, -10.0, 0.1))]
for name, precision, frame, yaw, speed in everything:
    stream(f"xbus-{name}", *[packet(utc(ns=10_000_000 * i) + counter(i) + fine(1000 + 100 * i) + euler(yaw, precision, frame) + place(precision) + velocity(*speed, precision, frame) + status()) for i in range(3)])
stream("xbus-f32-position-refused", packet(utc() + euler(47.25) + place(0) + status()))
half = math.radians(47.25) / 2
stream("xbus-quaternion-all-frames", *[packet(utc() + item(0x2010 | frame, reals([math.cos(math.radians(yaw) / 2), 0, 0, math.sin(math.radians(yaw) / 2)]))) for frame, yaw in ((0, 47.25), (NED, 42.75), (NWU, -42.75))])
stream("xbus-upside-down", packet(utc() + item(0x2010, reals([0, math.cos(half), math.sin(half), 0]))), packet(utc() + euler(47.25, roll=180.0)))
stream("xbus-south-west", packet(utc() + place(2, lat=-33.4489, lon=-70.6606) + status()))
stream("xbus-extended-length", packet(utc() + euler(47.25) + place() + status(), extended=True), packet(utc(second=31) + item(0x9990, bytes(200)) + item(0x9990, bytes(200)) + euler(48.25)))
stream("xbus-frame-bits-that-mean-nothing", packet(utc() + item(0x203C, reals([0, 0, 1]))))
stream("xbus-old-firmware-items", packet(item(0x8830, bytes(18)) + item(0x8840, bytes(52)) + item(0x88A0, bytes(100)) + euler(47.25) + item(0x4020, reals([0, 0, 9.8]))))

# --- Xbus: time and state
stream("xbus-utc-not-valid", packet(utc(flags=3) + fine(12345) + euler(47.25)), packet(utc(year=1999) + fine(12445) + euler(47.25)), packet(utc(month=13) + fine(12545) + euler(47.25)))
stream("xbus-utc-leap-second", packet(utc(month=12, day=31, hour=23, minute=59, second=60) + euler(47.25)))
stream("xbus-time-only", packet(utc() + counter(1)), packet(fine(99) + counter(2)))
stream("xbus-fine-wraps-and-restarts", *[packet(fine(ticks) + euler(47.25)) for ticks in (2**32 - 100, 2**32, 2**32 + 100, 50)])
stream("xbus-counter-gap", *[packet(counter(value) + euler(47.25)) for value in (65534, 65535, 3, 4)])
stream("xbus-no-fix-coasting-invalid", packet(utc() + place() + euler(47.25) + status(0x00000043)), packet(utc() + place() + euler(47.25) + status(0x00800043)), packet(utc() + place() + euler(47.25) + status(0x01800045)))
stream("xbus-receiver-only", packet(utc() + pvt()), packet(utc() + pvt(fix=0, flags=0)), packet(utc() + pvt(fix=3, flags=0x83)), packet(utc() + pvt(fix=1)))
stream("xbus-receiver-gives-deviation", packet(utc() + place() + status() + pvt()), packet(utc(ns=10_000_000) + place() + status()))
stream("xbus-nan", packet(utc() + euler(math.nan)), packet(utc() + item(0x2010, reals([0, 0, 0, 0]))), packet(utc() + place(lat=math.nan) + status()), packet(utc() + place(altitude=math.inf) + velocity(math.nan, 0, 0) + status()))
stream("xbus-null-island", packet(utc() + place(lat=0.0, lon=0.0) + status()))

# --- Xbus: framing
one = packet(utc() + counter(1) + euler(47.25) + place() + status())
stream("xbus-wrong-sum", one[:-1] + bytes([one[-1] ^ 1]), one)
stream("xbus-bit-errors", *[bytes(b ^ (0x10 if at == 7 * i + 3 else 0) for at, b in enumerate(one)) for i in range(8)], one)
stream("xbus-cut-at-the-start", one[17:], one)
stream("xbus-cut-at-the-end", one, one[:50])
stream("xbus-bytes-lost", one[:20], one[25:], one, one)
stream("xbus-false-starts", b"\xfa\xff\x36\xf0", one, b"\xfa\xff", one, b"\xfa\xfa\xff\x36", one, b"\xfa\xff\x36\xff\x08\x00", *[one] * 22)
stream("xbus-start-within-data", packet(utc(ns=0x05FAFF36 % 10**9) + item(0x9990, b"\xfa\xff\x36\x02\x00\x00$GPGGA,1\r\n") + euler(47.25)), one)
stream("xbus-length-too-long", b"\xfa\xff\x36\xff\x08\x01", one)
stream("xbus-item-too-long", packet(b"\x20\x30\x0c\x00\x00"), packet(b"\x20"), packet(b"\x20\x30\x0d" + bytes(13)), packet(b"\x10\x20\x01\x00"), one)
stream("xbus-empty", packet(b""), one)
stream("xbus-other-messages", packet(b"", 0x31), packet(b"\x03\x70\x03\xf8", 0x01), packet(b"\x28", 0x42), packet(b"\x10\x20\xff\xff", 0xC1), packet(b"\x00", 0x3E), one)

# --- both
stream("mixed", arduino(range(0, 2)), one, lines("HEHDT,42.8,T"), packet(utc(ns=10_000_000) + counter(2) + euler(47.25) + place() + status()), arduino(range(2, 4)))
stream("sentence-within-unfinished-packet", b"\xfa\xff\x36\xff\x07\xff", lines("HEHDT,42.8,T"), one[:30], lines("HEHDT,42.9,T"), one)
stream("packet-within-unfinished-sentence", "$GPGGA,0815", one, "30.00", lines("HEHDT,42.8,T"))
stream("arduino-boot-loader", b"\x00\xf0\x80\x1b[2J\x14\x10STK_500\x00\xff\xfe", nmea(gga("081529.90"))[50:], arduino(range(10, 13)))
generator = random.Random(3)
stream("random-bytes", bytes(generator.randrange(256) for _ in range(3000)), lines("HEHDT,42.8,T"), one)
noisy = bytearray((arduino(range(0, 12)).encode() + one * 4) * 2)
for at in range(97, len(noisy), 211):
    noisy[at] ^= 1 << generator.randrange(8)
stream("bit-error-every-211-bytes", bytes(noisy))

for old in HERE.glob("*.bin"):
    old.unlink()
for name, data in streams.items():
    (HERE / f"{name}.bin").write_bytes(data)
print(len(streams), "streams,", sum(map(len, streams.values())), "bytes")
