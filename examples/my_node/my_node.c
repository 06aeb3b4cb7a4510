/* A node in C: prints the hidden objects of a running graph, and says how fast the vehicle drives.
 *
 *     ./my_node RUN_DIR [SPEED_MPS [SECONDS]]
 *
 * It reads perception/hidden_objects, publishes vehicle/state 50 times a second and its heartbeat twice a second. RUN_DIR
 * is what `mirrorwave doctor` names. The wire: docs/guides/own-parts.md. */

#define _POSIX_C_SOURCE 200809L

#include <dirent.h>
#include <inttypes.h>
#include <msgpack.h>
#include <stdio.h>
#include <stdlib.h>
#include <string.h>
#include <time.h>
#include <unistd.h>
#include <zmq.h>

#define NAME "my_node"
#define HEARD "perception/hidden_objects"
#define MAX_PUBLISHERS 16
#define MAX_MESSAGE_BYTES (4 << 20)

static int64_t now_ns(void) {
    struct timespec now;
    clock_gettime(CLOCK_MONOTONIC, &now); /* the bus clock */
    return 1000000000 * (int64_t)now.tv_sec + now.tv_nsec;
}

/* ---- publishing: one socket a topic, at RUN_DIR/<topic with . for />@<node> */

typedef struct {
    const char *topic;
    void *socket;
    int64_t sequence;
} Publisher;

static int socket_address(char *address, size_t size, const char *run_dir, const char *topic, const char *node) {
    int length = snprintf(address, size, "ipc://%s/%s@%s", run_dir, topic, node);
    for (char *c = address + strlen("ipc://") + strlen(run_dir) + 1; *c && *c != '@'; c++)
        if (*c == '/') *c = '.';
    return length > 0 && (size_t)length < size;
}

static int advertise(Publisher *publisher, void *context, const char *run_dir) {
    char address[128];
    int linger_ms = 200;
    publisher->socket = zmq_socket(context, ZMQ_PUB);
    zmq_setsockopt(publisher->socket, ZMQ_LINGER, &linger_ms, sizeof linger_ms);
    return socket_address(address, sizeof address, run_dir, publisher->topic, NAME) &&
           zmq_bind(publisher->socket, address) == 0;
}

static void pack_text(msgpack_packer *packer, const char *text) {
    msgpack_pack_str(packer, strlen(text));
    msgpack_pack_str_body(packer, text, strlen(text));
}

static void pack_int(msgpack_packer *packer, const char *key, int64_t value) {
    pack_text(packer, key);
    msgpack_pack_int64(packer, value);
}

/* Begin a header {"envelope": {...}, "body": {`fields` entries}}; the caller packs the entries of the body. */
static void begin_message(msgpack_packer *packer, const Publisher *publisher, size_t fields) {
    msgpack_pack_map(packer, 2);
    pack_text(packer, "envelope");
    msgpack_pack_map(packer, 5);
    pack_int(packer, "protocol", 1);
    pack_text(packer, "publisher"), pack_text(packer, NAME);
    pack_text(packer, "topic"), pack_text(packer, publisher->topic);
    pack_int(packer, "sequence", publisher->sequence);
    pack_int(packer, "sent_ns", now_ns());
    pack_text(packer, "body");
    msgpack_pack_map(packer, fields);
}

/* Two frames: the topic's name with its zero byte, the header. Arrays would follow as frames of their own. */
static void send_message(Publisher *publisher, msgpack_sbuffer *header) {
    zmq_send(publisher->socket, publisher->topic, strlen(publisher->topic) + 1, ZMQ_SNDMORE);
    zmq_send(publisher->socket, header->data, header->size, 0);
    publisher->sequence++;
    msgpack_sbuffer_clear(header);
}

static void publish_state(Publisher *publisher, msgpack_sbuffer *header, double speed_mps) {
    msgpack_packer packer;
    msgpack_packer_init(&packer, header, msgpack_sbuffer_write);
    begin_message(&packer, publisher, 2);
    pack_int(&packer, "stamp_ns", now_ns());
    pack_text(&packer, "speed_mps"), msgpack_pack_double(&packer, speed_mps);
    send_message(publisher, header);
}

static void publish_heartbeat(Publisher *publisher, msgpack_sbuffer *header, const char *state, double uptime_s) {
    msgpack_packer packer;
    msgpack_packer_init(&packer, header, msgpack_sbuffer_write);
    begin_message(&packer, publisher, 5);
    pack_int(&packer, "stamp_ns", now_ns());
    pack_text(&packer, "node"), pack_text(&packer, NAME);
    pack_int(&packer, "pid", getpid());
    pack_text(&packer, "state"), pack_text(&packer, state);
    pack_text(&packer, "uptime_s"), msgpack_pack_double(&packer, uptime_s);
    send_message(publisher, header);
}

/* ---- receiving: connect to every publisher there is, now and later */

typedef struct {
    void *socket;
    char names[MAX_PUBLISHERS][64];
    int count;
} Subscriber;

static void connect_new(Subscriber *subscriber, const char *run_dir) {
    DIR *folder = opendir(run_dir);
    struct dirent *entry;
    while (folder && (entry = readdir(folder))) {
        const char *node = strchr(entry->d_name, '@');
        char address[128], expected[128];
        if (!node || strlen(++node) >= sizeof subscriber->names[0] || subscriber->count == MAX_PUBLISHERS) continue;
        if (!socket_address(address, sizeof address, run_dir, HEARD, node)) continue;
        snprintf(expected, sizeof expected, "%s", strrchr(address, '/') + 1);
        int is_new = strcmp(expected, entry->d_name) == 0;
        for (int i = 0; i < subscriber->count; i++) is_new &= strcmp(subscriber->names[i], node) != 0;
        /* ZeroMQ reconnects by itself when a publisher comes back to its path */
        if (is_new && zmq_connect(subscriber->socket, address) == 0)
            strcpy(subscriber->names[subscriber->count++], node);
    }
    if (folder) closedir(folder);
}

/* Return the value of a key, or NULL where `object` is no map or lacks it. */
static const msgpack_object *value_of(const msgpack_object *object, const char *key) {
    if (!object || object->type != MSGPACK_OBJECT_MAP) return NULL;
    for (uint32_t i = 0; i < object->via.map.size; i++) {
        const msgpack_object_kv *entry = &object->via.map.ptr[i];
        if (entry->key.type == MSGPACK_OBJECT_STR && entry->key.via.str.size == strlen(key) &&
            memcmp(entry->key.via.str.ptr, key, strlen(key)) == 0)
            return &entry->val;
    }
    return NULL;
}

static double number(const msgpack_object *value) {
    if (!value) return 0.0;
    if (value->type == MSGPACK_OBJECT_POSITIVE_INTEGER) return (double)value->via.u64;
    if (value->type == MSGPACK_OBJECT_NEGATIVE_INTEGER) return (double)value->via.i64;
    return value->type == MSGPACK_OBJECT_FLOAT64 || value->type == MSGPACK_OBJECT_FLOAT32 ? value->via.f64 : 0.0;
}

/* Print one scan; `next` is the sequence number that would follow without loss, -1 at first. One publisher is assumed:
 * with several, keep one `next` for each name in the envelope. */
static int64_t print_objects(const char *header, size_t size, int64_t next) {
    msgpack_unpacked unpacked;
    msgpack_unpacked_init(&unpacked);
    if (msgpack_unpack_next(&unpacked, header, size, NULL) == MSGPACK_UNPACK_SUCCESS) {
        const msgpack_object *body = value_of(&unpacked.data, "body");
        const msgpack_object *objects = value_of(body, "objects"), *ego = value_of(body, "ego");
        int64_t sequence = (int64_t)number(value_of(value_of(&unpacked.data, "envelope"), "sequence"));
        if (next >= 0 && sequence > next) printf("%" PRId64 " scans lost\n", sequence - next);
        next = sequence + 1;
        printf("scan %.0f, vehicle at %.1f m/s:", number(value_of(body, "scan_id")), number(value_of(ego, "speed_mps")));
        uint32_t count = objects && objects->type == MSGPACK_OBJECT_ARRAY ? objects->via.array.size : 0;
        for (uint32_t i = 0; i < count; i++) {
            const msgpack_object *object = &objects->via.array.ptr[i];
            printf(" %.1f, %.1f m;", number(value_of(object, "x_m")), number(value_of(object, "y_m")));
        }
        printf(count ? "\n" : " nothing hidden\n");
        fflush(stdout);
    }
    msgpack_unpacked_destroy(&unpacked);
    return next;
}

/* Take one message off the socket: frame 0 is the topic, frame 1 the header, the others are arrays. */
static int64_t receive(Subscriber *subscriber, int64_t next) {
    int more = 1;
    for (int frame = 0; more; frame++) {
        zmq_msg_t message;
        zmq_msg_init(&message);
        if (zmq_msg_recv(&message, subscriber->socket, 0) < 0) return next;
        if (frame == 1) next = print_objects(zmq_msg_data(&message), zmq_msg_size(&message), next);
        more = zmq_msg_more(&message);
        zmq_msg_close(&message);
    }
    return next;
}

int main(int argc, char **argv) {
    if (argc < 2 || argc > 4) {
        fprintf(stderr, "usage: my_node RUN_DIR [SPEED_MPS [SECONDS]]\n");
        return 2;
    }
    double speed_mps = argc > 2 ? atof(argv[2]) : 0.0;
    int64_t start_ns = now_ns(), end_ns = argc > 3 ? start_ns + (int64_t)(1e9 * atof(argv[3])) : INT64_MAX;
    int64_t beat_ns = start_ns, state_ns = start_ns, search_ns = start_ns, limit = MAX_MESSAGE_BYTES, next = -1;
    void *context = zmq_ctx_new();
    Publisher state = {"vehicle/state", NULL, 0}, heartbeat = {"diagnostics/node", NULL, 0};
    Subscriber subscriber = {zmq_socket(context, ZMQ_SUB), {{0}}, 0};
    msgpack_sbuffer header;
    msgpack_sbuffer_init(&header);
    if (!advertise(&state, context, argv[1]) || !advertise(&heartbeat, context, argv[1])) {
        fprintf(stderr, "my_node: %s: %s\n", argv[1], zmq_strerror(zmq_errno()));
        return 1;
    }
    zmq_setsockopt(subscriber.socket, ZMQ_MAXMSGSIZE, &limit, sizeof limit);
    /* with its zero byte, so that no topic is another's beginning */
    zmq_setsockopt(subscriber.socket, ZMQ_SUBSCRIBE, HEARD, strlen(HEARD) + 1);
    for (int64_t now = start_ns; now < end_ns; now = now_ns()) {
        zmq_pollitem_t item = {subscriber.socket, 0, ZMQ_POLLIN, 0};
        if (now >= search_ns) connect_new(&subscriber, argv[1]), search_ns = now + 100000000;
        if (now >= state_ns) publish_state(&state, &header, speed_mps), state_ns = now + 20000000;
        if (now >= beat_ns) publish_heartbeat(&heartbeat, &header, "ready", 1e-9 * (now - start_ns)), beat_ns = now + 500000000;
        if (zmq_poll(&item, 1, 10) > 0) next = receive(&subscriber, next);
    }
    publish_heartbeat(&heartbeat, &header, "stopping", 1e-9 * (now_ns() - start_ns));
    msgpack_sbuffer_destroy(&header);
    zmq_close(subscriber.socket), zmq_close(state.socket), zmq_close(heartbeat.socket);
    zmq_ctx_term(context);
    return 0;
}
