/* A camera that is not there: an LD_PRELOAD library that answers V4L2 requests for one path.
 *
 * The descriptor that `open` returns is the read end of a pipe. A filled buffer is a byte in it and unplugging closes
 * the other end, so that the program's poll system call works as on a real device: POLLIN, or POLLHUP. Buffers lie in
 * a memfd, which `mmap` of that descriptor maps instead. The rules of the V4L2 manual are kept strictly: who queues a
 * buffer twice, or frees buffers that are mapped, gets the kernel's error.
 *
 * The crate v4l makes its requests through `syscall(SYS_ioctl, ...)`, so that function is wrapped as well.
 *
 * Environment:
 *   SHIM_DEVICE      the path that is the camera
 *   SHIM_FRAMES      JPEG files, separated by colons, sent in turn
 *   SHIM_RATE_HZ     frames a second
 *   SHIM_LOG         a file that gets one line per request of interest
 *   SHIM_LOCK        a lock file: who has it owns the camera; others get EBUSY
 *   SHIM_OPEN_ERRNO  `open` fails with it
 *   SHIM_FAULTS      separated by spaces. For good: no_dht no_mjpg no_streaming metadata_node realtime end_of_frame
 *                    small refuse_rate no_bandwidth. At the n-th frame since the program started,
 *                    the first is 0: garbage@n truncate@n error@n empty@n stray@n padding@n gap@n eio@n past@n
 *                    future@n stall@n unplug@n
 *   SHIM_REPLUG_MS   after unplugging the path is missing for so long
 */
#define _GNU_SOURCE
#include <dlfcn.h>
#include <errno.h>
#include <fcntl.h>
#include <linux/videodev2.h>
#include <pthread.h>
#include <stdarg.h>
#include <stdio.h>
#include <stdlib.h>
#include <string.h>
#include <sys/file.h>
#include <sys/mman.h>
#include <sys/stat.h>
#include <sys/syscall.h>
#include <time.h>
#include <unistd.h>

#define MAX_BUFFERS 32
#define MAX_FRAMES 16
#define BUFFER_BYTES (4u << 20)
#define GAP 3

enum owner { PROGRAM, QUEUED, FILLED };

static struct {
    pthread_mutex_t lock;
    int fd, pipe_in, memfd, lock_fd;
    struct v4l2_pix_format format;
    struct v4l2_fract interval;
    unsigned count;
    enum owner owner[MAX_BUFFERS];
    struct v4l2_buffer meta[MAX_BUFFERS];
    unsigned queued[MAX_BUFFERS], queued_length;
    unsigned filled[MAX_BUFFERS], filled_length;
    void *mapped[MAX_BUFFERS];
    int streaming, gone, fail_reads;
    pthread_t producer;
    unsigned sequence;
} camera = {.lock = PTHREAD_MUTEX_INITIALIZER, .fd = -1, .pipe_in = -1, .memfd = -1, .lock_fd = -1};

/* Since the program started. */
static unsigned frame_number;
static struct timespec unplugged_at;
static struct {
    unsigned char *bytes;
    size_t length;
} frames[MAX_FRAMES];
static unsigned frames_length;

static void log_line(const char *format, ...) {
    const char *path = getenv("SHIM_LOG");
    if (!path) return;
    FILE *file = fopen(path, "a");
    if (!file) return;
    va_list arguments;
    va_start(arguments, format);
    vfprintf(file, format, arguments);
    va_end(arguments);
    fputc('\n', file);
    fclose(file);
}

static int has_word(const char *word) {
    const char *faults = getenv("SHIM_FAULTS");
    size_t length = strlen(word);
    for (const char *at = faults; at && (at = strstr(at, word)); at += length)
        if ((at == faults || at[-1] == ' ') && (at[length] == 0 || at[length] == ' ')) return 1;
    return 0;
}

static int due(const char *fault, unsigned number) {
    char word[64];
    snprintf(word, sizeof word, "%s@%u", fault, number);
    return has_word(word);
}

static long elapsed_ms(struct timespec since) {
    struct timespec now;
    clock_gettime(CLOCK_MONOTONIC, &now);
    return (now.tv_sec - since.tv_sec) * 1000 + (now.tv_nsec - since.tv_nsec) / 1000000;
}

static size_t without_tables(unsigned char *jpeg, size_t length) {
    size_t at = 2;
    while (at + 4 <= length && jpeg[at] == 0xFF && jpeg[at + 1] != 0xDA) {
        size_t segment = 2 + (jpeg[at + 2] << 8 | jpeg[at + 3]);
        if (jpeg[at + 1] == 0xC4) {
            memmove(jpeg + at, jpeg + at + segment, length - at - segment);
            length -= segment;
        } else {
            at += segment;
        }
    }
    return length;
}

static void load_frames(void) {
    char *list = strdup(getenv("SHIM_FRAMES") ? getenv("SHIM_FRAMES") : ""), *rest = list, *path;
    while (frames_length < MAX_FRAMES && (path = strsep(&rest, ":")) && *path) {
        FILE *file = fopen(path, "rb");
        if (!file) abort();
        unsigned char *bytes = malloc(BUFFER_BYTES);
        size_t length = fread(bytes, 1, BUFFER_BYTES / 2, file);
        fclose(file);
        if (has_word("no_dht")) length = without_tables(bytes, length);
        frames[frames_length].bytes = bytes;
        frames[frames_length++].length = length;
    }
    free(list);
}

static size_t fill(unsigned char *buffer, unsigned number) {
    if (camera.format.pixelformat == V4L2_PIX_FMT_YUYV) {
        for (unsigned y = 0; y < camera.format.height; y++)
            for (unsigned x = 0; x < camera.format.width; x++) {
                buffer[y * camera.format.bytesperline + 2 * x] = 16 + (x + y + number) % 220;
                buffer[y * camera.format.bytesperline + 2 * x + 1] = 128;
            }
        return camera.format.sizeimage / (due("truncate", number) ? 2 : 1);
    }
    size_t length = frames[number % frames_length].length;
    memcpy(buffer, frames[number % frames_length].bytes, length);
    if (due("garbage", number)) memset(buffer, 0xAB, length = 3000);
    if (due("truncate", number)) length = length * 6 / 10;
    if (due("stray", number)) memcpy(buffer + length, "\x13\x37", 2), length += 2;
    if (due("padding", number)) memset(buffer + length, 0, 1000), length += 1000;
    return length;
}

/* Fills the buffer that was queued first. Without one it waits, so that tests count the same on a slow machine; a real
 * driver would drop the frame, which gap@n stands for. */
static void produce(void) {
    if (camera.queued_length == 0) return;
    unsigned number = frame_number++;
    if (due("gap", number)) camera.sequence += GAP;
    unsigned sequence = camera.sequence++;
    if (due("eio", number)) {
        camera.fail_reads++;
        if (write(camera.pipe_in, "", 1) != 1) abort();
        return;
    }
    unsigned index = camera.queued[0];
    memmove(camera.queued, camera.queued + 1, --camera.queued_length * sizeof *camera.queued);

    unsigned char *buffer = mmap(NULL, BUFFER_BYTES, PROT_READ | PROT_WRITE, MAP_SHARED, camera.memfd,
                                 (off_t)index * BUFFER_BYTES);
    if (buffer == MAP_FAILED) abort();
    struct v4l2_buffer *meta = &camera.meta[index];
    memset(meta, 0, sizeof *meta);
    meta->bytesused = due("empty", number) ? 0 : fill(buffer, number);
    syscall(SYS_munmap, buffer, BUFFER_BYTES);

    struct timespec now;
    clock_gettime(has_word("realtime") ? CLOCK_REALTIME : CLOCK_MONOTONIC, &now);
    long exposure_us = 30000, us = now.tv_nsec / 1000 - exposure_us;
    meta->timestamp.tv_sec = now.tv_sec - (us < 0) - 100 * due("past", number) + 100 * due("future", number);
    meta->timestamp.tv_usec = us < 0 ? us + 1000000 : us;
    meta->index = index;
    meta->sequence = sequence;
    meta->flags = V4L2_BUF_FLAG_MAPPED | V4L2_BUF_FLAG_DONE;
    if (!has_word("realtime")) meta->flags |= V4L2_BUF_FLAG_TIMESTAMP_MONOTONIC;
    if (!has_word("end_of_frame")) meta->flags |= V4L2_BUF_FLAG_TSTAMP_SRC_SOE;
    if (due("error", number)) meta->flags |= V4L2_BUF_FLAG_ERROR;
    camera.owner[index] = FILLED;
    camera.filled[camera.filled_length++] = index;
    if (write(camera.pipe_in, "", 1) != 1) abort();
}

static void unplug(void) {
    log_line("unplugged");
    camera.gone = 1;
    clock_gettime(CLOCK_MONOTONIC, &unplugged_at);
    close(camera.pipe_in);
    camera.pipe_in = -1;
}

static void *produce_at_rate(void *unused) {
    long rate_hz = getenv("SHIM_RATE_HZ") ? atol(getenv("SHIM_RATE_HZ")) : 30;
    struct timespec pause = {.tv_nsec = 1000000000L / rate_hz};
    int stalled = 0;
    for (;;) {
        nanosleep(&pause, NULL);
        pthread_mutex_lock(&camera.lock);
        int ended = !camera.streaming || camera.gone;
        if (!ended && due("unplug", frame_number)) unplug(), frame_number++, ended = 1;
        if (due("stall", frame_number)) stalled = 1, frame_number++;
        if (!ended && !stalled) produce();
        pthread_mutex_unlock(&camera.lock);
        if (ended) return unused;
    }
}

static int fail(int code) {
    errno = code;
    return -1;
}

static int stream_off(void) {
    int was = camera.streaming;
    camera.streaming = 0;
    pthread_mutex_unlock(&camera.lock);
    if (was) pthread_join(camera.producer, NULL);
    pthread_mutex_lock(&camera.lock);
    char drained;
    while (camera.filled_length > 0 && read(camera.fd, &drained, 1) == 1) camera.filled_length--;
    camera.queued_length = camera.filled_length = 0;
    for (unsigned i = 0; i < MAX_BUFFERS; i++) camera.owner[i] = PROGRAM;
    return 0;
}

static int query_capabilities(struct v4l2_capability *answer) {
    /* Latin-1, as some cameras have it: no UTF-8. */
    strcpy((char *)answer->card, "Cam\xE9ra simul\xE9" "e");
    strcpy((char *)answer->driver, "shim");
    answer->capabilities = V4L2_CAP_DEVICE_CAPS | V4L2_CAP_VIDEO_CAPTURE | V4L2_CAP_STREAMING;
    answer->device_caps = has_word("metadata_node") ? V4L2_CAP_META_CAPTURE : V4L2_CAP_VIDEO_CAPTURE;
    if (!has_word("no_streaming")) answer->device_caps |= V4L2_CAP_STREAMING;
    return 0;
}

static int enumerate_formats(struct v4l2_fmtdesc *answer) {
    unsigned formats[] = {V4L2_PIX_FMT_YUYV, V4L2_PIX_FMT_MJPEG};
    if (answer->index >= (has_word("no_mjpg") ? 1 : 2)) return fail(EINVAL);
    answer->pixelformat = formats[answer->index];
    memcpy(answer->description, "\xFF\xFE", 2);
    return 0;
}

static int enumerate_sizes(struct v4l2_frmsizeenum *answer) {
    unsigned sizes[][2] = {{640, 480}, {1280, 720}};
    if (answer->index >= (has_word("small") ? 1 : 2)) return fail(EINVAL);
    answer->type = V4L2_FRMSIZE_TYPE_DISCRETE;
    answer->discrete.width = sizes[answer->index][0];
    answer->discrete.height = sizes[answer->index][1];
    return 0;
}

static int set_format(struct v4l2_format *wanted) {
    const char *lock = getenv("SHIM_LOCK");
    if (lock && camera.lock_fd < 0) {
        camera.lock_fd = syscall(SYS_openat, AT_FDCWD, lock, O_RDWR | O_CREAT | O_CLOEXEC, 0600);
        if (flock(camera.lock_fd, LOCK_EX | LOCK_NB) != 0) return fail(EBUSY);
    }
    struct v4l2_pix_format *pix = &wanted->fmt.pix;
    if (pix->pixelformat != V4L2_PIX_FMT_YUYV) pix->pixelformat = V4L2_PIX_FMT_MJPEG;
    if (has_word("no_mjpg")) pix->pixelformat = V4L2_PIX_FMT_YUYV;
    if (has_word("small") || pix->width < 1280) pix->width = 640, pix->height = 480;
    else pix->width = 1280, pix->height = 720;
    int raw = pix->pixelformat == V4L2_PIX_FMT_YUYV;
    pix->bytesperline = raw ? pix->width * 2 + 64 : 0;
    pix->sizeimage = raw ? pix->bytesperline * pix->height : BUFFER_BYTES;
    pix->field = V4L2_FIELD_NONE;
    /* One that the crate v4l does not know. */
    pix->colorspace = 4;
    camera.format = *pix;
    return 0;
}

static int parameters(struct v4l2_streamparm *wanted, int set) {
    if (set) camera.interval = has_word("refuse_rate") ? (struct v4l2_fract){1, 10} : wanted->parm.capture.timeperframe;
    wanted->parm.capture.timeperframe = camera.interval;
    return 0;
}

static int request_buffers(struct v4l2_requestbuffers *wanted) {
    for (unsigned i = 0; i < MAX_BUFFERS; i++)
        if (camera.mapped[i]) return log_line("reqbufs while mapped"), fail(EBUSY);
    if (wanted->count > MAX_BUFFERS) wanted->count = MAX_BUFFERS;
    camera.count = wanted->count;
    log_line("reqbufs %u", wanted->count);
    return 0;
}

static int query_buffer(struct v4l2_buffer *answer) {
    if (answer->index >= camera.count) return fail(EINVAL);
    answer->length = BUFFER_BYTES;
    answer->m.offset = answer->index * BUFFER_BYTES;
    return 0;
}

static int queue(struct v4l2_buffer *buffer) {
    if (camera.gone) return fail(ENODEV);
    if (buffer->index >= camera.count || camera.owner[buffer->index] != PROGRAM)
        return log_line("qbuf of a buffer that the driver owns"), fail(EINVAL);
    camera.owner[buffer->index] = QUEUED;
    camera.queued[camera.queued_length++] = buffer->index;
    return 0;
}

static int dequeue(struct v4l2_buffer *buffer) {
    char taken;
    if (camera.gone) return fail(ENODEV);
    if (read(camera.fd, &taken, 1) != 1) return fail(EAGAIN);
    if (camera.fail_reads > 0) return camera.fail_reads--, fail(EIO);
    unsigned index = camera.filled[0];
    memmove(camera.filled, camera.filled + 1, --camera.filled_length * sizeof *camera.filled);
    camera.owner[index] = PROGRAM;
    *buffer = camera.meta[index];
    return 0;
}

static int stream_on(void) {
    if (has_word("no_bandwidth")) return fail(ENOSPC);
    if (camera.queued_length < camera.count) log_line("streamon with %u of %u queued", camera.queued_length, camera.count);
    camera.streaming = 1;
    log_line("streamon");
    return pthread_create(&camera.producer, NULL, produce_at_rate, NULL) ? fail(EIO) : 0;
}

static int set_control(const struct v4l2_control *wanted) {
    if (wanted->id != V4L2_CID_POWER_LINE_FREQUENCY && wanted->id != V4L2_CID_EXPOSURE_AUTO_PRIORITY)
        return fail(EINVAL);
    log_line("control %x %d", wanted->id, wanted->value);
    return 0;
}

static int request(unsigned long number, void *argument) {
    if (camera.gone && number != VIDIOC_DQBUF) {
        if (number == VIDIOC_STREAMOFF) stream_off(), log_line("streamoff");
        return fail(ENODEV);
    }
    switch (number) {
    case VIDIOC_QUERYCAP: return query_capabilities(argument);
    case VIDIOC_ENUM_FMT: return enumerate_formats(argument);
    case VIDIOC_ENUM_FRAMESIZES: return enumerate_sizes(argument);
    case VIDIOC_S_FMT: return set_format(argument);
    case VIDIOC_G_FMT: return ((struct v4l2_format *)argument)->fmt.pix = camera.format, 0;
    case VIDIOC_S_PARM: return parameters(argument, 1);
    case VIDIOC_G_PARM: return parameters(argument, 0);
    case VIDIOC_S_CTRL: return set_control(argument);
    case VIDIOC_REQBUFS: return request_buffers(argument);
    case VIDIOC_QUERYBUF: return query_buffer(argument);
    case VIDIOC_QBUF: return queue(argument);
    case VIDIOC_DQBUF: return dequeue(argument);
    case VIDIOC_STREAMON: return stream_on();
    case VIDIOC_STREAMOFF: return log_line("streamoff"), stream_off();
    default: return fail(ENOTTY);
    }
}

static int locked_request(unsigned long number, void *argument) {
    pthread_mutex_lock(&camera.lock);
    int answer = request(number, argument);
    int code = errno;
    pthread_mutex_unlock(&camera.lock);
    errno = code;
    return answer;
}

static int open_camera(int flags) {
    const char *code = getenv("SHIM_OPEN_ERRNO");
    if (code) return fail(atoi(code));
    if (camera.gone && elapsed_ms(unplugged_at) < atol(getenv("SHIM_REPLUG_MS") ? getenv("SHIM_REPLUG_MS") : "1000000"))
        return fail(ENOENT);
    if (!(flags & O_NONBLOCK) || !(flags & O_CLOEXEC)) log_line("opened without O_NONBLOCK or O_CLOEXEC");
    if (frames_length == 0) load_frames();
    int ends[2];
    if (pipe2(ends, O_NONBLOCK | O_CLOEXEC) != 0) return -1;
    camera.fd = ends[0];
    camera.pipe_in = ends[1];
    camera.memfd = memfd_create("frames", MFD_CLOEXEC);
    if (camera.memfd < 0 || ftruncate(camera.memfd, (off_t)MAX_BUFFERS * BUFFER_BYTES) != 0) abort();
    camera.gone = 0;
    camera.sequence = 0;
    log_line("open");
    return camera.fd;
}

static int is_camera(const char *path) {
    const char *device = getenv("SHIM_DEVICE");
    return device && strcmp(path, device) == 0;
}

int open(const char *path, int flags, ...) {
    va_list arguments;
    va_start(arguments, flags);
    int mode = flags & (O_CREAT | O_TMPFILE) ? va_arg(arguments, int) : 0;
    va_end(arguments);
    return is_camera(path) ? open_camera(flags) : (int)syscall(SYS_openat, AT_FDCWD, path, flags, mode);
}

int open64(const char *path, int flags, ...) __attribute__((alias("open")));

int close(int fd) {
    if (fd >= 0 && fd == camera.fd) {
        unsigned mapped = 0;
        for (unsigned i = 0; i < MAX_BUFFERS; i++) mapped += camera.mapped[i] != NULL;
        log_line("close: streaming %d, mapped %u", camera.streaming, mapped);
        if (camera.pipe_in >= 0) syscall(SYS_close, camera.pipe_in);
        syscall(SYS_close, camera.memfd);
        if (camera.lock_fd >= 0) syscall(SYS_close, camera.lock_fd);
        camera.fd = camera.pipe_in = camera.memfd = camera.lock_fd = -1;
    }
    return (int)syscall(SYS_close, fd);
}

void *mmap(void *start, size_t length, int protection, int flags, int fd, off_t offset) {
    int of_camera = fd >= 0 && fd == camera.fd;
    void *mapped = (void *)syscall(SYS_mmap, start, length, protection, flags, of_camera ? camera.memfd : fd, offset);
    if (of_camera && mapped != MAP_FAILED) camera.mapped[offset / BUFFER_BYTES] = mapped;
    return mapped;
}

void *mmap64(void *, size_t, int, int, int, off_t) __attribute__((alias("mmap")));

int munmap(void *start, size_t length) {
    for (unsigned i = 0; i < MAX_BUFFERS; i++)
        if (camera.mapped[i] == start) camera.mapped[i] = NULL;
    return (int)syscall(SYS_munmap, start, length);
}

long syscall(long number, ...) {
    static long (*real)(long, ...);
    if (!real) real = (long (*)(long, ...))dlsym(RTLD_NEXT, "syscall");
    long a[6];
    va_list arguments;
    va_start(arguments, number);
    for (int i = 0; i < 6; i++) a[i] = va_arg(arguments, long);
    va_end(arguments);
    if (number == SYS_ioctl && camera.fd >= 0 && (int)a[0] == camera.fd) return locked_request(a[1], (void *)a[2]);
    return real(number, a[0], a[1], a[2], a[3], a[4], a[5]);
}
