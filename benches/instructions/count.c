/* Plugin of qemu-user: how many instructions each piece of translated code ran, as lines `address instructions` in the
 * file that the argument `out=FILE` names; its first line is where the program's code starts. Of QEMU's plugin interface,
 * version 1 (QEMU 4.2 to 8.2), it declares what it uses, as Debian packages no header. Counters are not atomic: threads
 * may lose counts. */
#include <inttypes.h>
#include <stddef.h>
#include <stdint.h>
#include <stdio.h>
#include <stdlib.h>
#include <string.h>

typedef uint64_t qemu_plugin_id_t;
struct qemu_plugin_tb;
enum qemu_plugin_op { QEMU_PLUGIN_INLINE_ADD_U64 };
void qemu_plugin_register_vcpu_tb_trans_cb(qemu_plugin_id_t id,
                                           void (*callback)(qemu_plugin_id_t, struct qemu_plugin_tb *));
void qemu_plugin_register_vcpu_tb_exec_inline(struct qemu_plugin_tb *tb, enum qemu_plugin_op op, void *counter,
                                              uint64_t increment);
void qemu_plugin_register_atexit_cb(qemu_plugin_id_t id, void (*callback)(qemu_plugin_id_t, void *), void *data);
size_t qemu_plugin_tb_n_insns(const struct qemu_plugin_tb *tb);
uint64_t qemu_plugin_tb_vaddr(const struct qemu_plugin_tb *tb);
uint64_t qemu_plugin_start_code(void);

int qemu_plugin_version = 1;

/* In a list, as translated code keeps the address of its counter. Code that is translated again gets another one. */
struct block {
    uint64_t address;
    uint64_t instructions;
    struct block *before;
};

static struct block *last;
static FILE *out;

static void translated(qemu_plugin_id_t id, struct qemu_plugin_tb *tb)
{
    (void)id;
    struct block *block = calloc(1, sizeof *block);
    if (block == NULL) {
        perror("count.c");
        abort();
    }
    block->address = qemu_plugin_tb_vaddr(tb);
    block->before = last;
    last = block;
    qemu_plugin_register_vcpu_tb_exec_inline(tb, QEMU_PLUGIN_INLINE_ADD_U64, &block->instructions,
                                             qemu_plugin_tb_n_insns(tb));
}

static void at_exit(qemu_plugin_id_t id, void *data)
{
    (void)id;
    (void)data;
    fprintf(out, "%" PRIx64 "\n", qemu_plugin_start_code());
    for (const struct block *block = last; block != NULL; block = block->before) {
        fprintf(out, "%" PRIx64 " %" PRIu64 "\n", block->address, block->instructions);
    }
    fclose(out);
}

int qemu_plugin_install(qemu_plugin_id_t id, const void *info, int argc, char **argv)
{
    (void)info;
    for (int i = 0; i < argc; i++) {
        if (strncmp(argv[i], "out=", 4) == 0) {
            out = fopen(argv[i] + 4, "w");
        }
    }
    if (out == NULL) {
        fputs("count.c: needs out=FILE, a file that can be written\n", stderr);
        return 1;
    }
    qemu_plugin_register_vcpu_tb_trans_cb(id, translated);
    qemu_plugin_register_atexit_cb(id, at_exit, NULL);
    return 0;
}
