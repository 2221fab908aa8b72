// AVX-VNNI on a processor that has AVX512-VNNI instead: the same four products (VPDPBUSD, VPDPBUSDS, VPDPWSSD,
// VPDPWSSDS), encoded with VEX there and with EVEX here. A product with VEX is an illegal instruction; where one is met,
// it and the VEX instructions after it are copied to a page nearby with the products encoded anew, and a jump takes its
// place. Encodings: Intel's manual, volume 2, sections 2.3 and 2.7; the order of writing is that of Linux's
// text_poke_bp().
#include <linux/membarrier.h>
#include <sched.h>
#include <stdatomic.h>
#include <stdint.h>
#include <sys/syscall.h>

#define LONGEST 15      // bytes of an instruction
#define COPIED 64       // instructions of a copy at most
#define JUMP 5          // bytes of a jump, and of the shortest product with VEX
#define PAGES (1 << 20) // bytes of copies that are reserved at once
#define NEAR (1L << 30) // bytes that a copy may be away

typedef struct {
  int length, map, opcode, modrm, displacement, relative;  // offsets in bytes; relative: to the next instruction
} Vex;

static int has_immediate(int map, int opcode) {
  return map == 3 || (map == 1 && ((opcode >= 0x70 && opcode <= 0x73) || (opcode >= 0xc2 && opcode <= 0xc6 && opcode != 0xc3)));
}

static int read_vex(const uint8_t *code, Vex *found) {
  if (code[0] != 0xc4 && code[0] != 0xc5) return 0;
  int at = code[0] == 0xc4 ? 3 : 2;
  *found = (Vex){.map = code[0] == 0xc4 ? code[1] & 31 : 1, .opcode = code[at], .modrm = at + 1};
  if (found->map < 1 || found->map > 3) return 0;
  if (found->map == 1 && found->opcode == 0x77) return found->length = at + 1;  // VZEROUPPER has no operands
  int mod = code[at + 1] >> 6, rm = code[at + 1] & 7;
  at += 2;
  int base = mod != 3 && rm == 4 ? code[at++] & 7 : rm;
  found->displacement = at;
  found->relative = mod == 0 && rm == 5;
  at += mod == 1 ? 1 : mod == 2 || (mod == 0 && base == 5) ? 4 : 0;
  return found->length = at + has_immediate(found->map, found->opcode);
}

static int is_product(const uint8_t *code, const Vex *vex) {  // VEX.66.0F38.W0 50 to 53
  return code[0] == 0xc4 && vex->map == 2 && (code[2] & 0x83) == 1 && vex->opcode >= 0x50 && vex->opcode <= 0x53;
}

static int encode_evex(const uint8_t *code, const Vex *vex, uint8_t *out) {
  int modrm = code[vex->modrm], mod = modrm >> 6, size = 0;
  out[size++] = 0x62;
  out[size++] = (code[1] & 0xe0) | 0x12 | (mod == 3 ? 0x40 : 0);  // R X B, R' unused, map 2; X extends a register here
  out[size++] = (code[2] & 0x78) | 0x05;                          // W0, vvvv, pp 66
  out[size++] = 0x08 | (code[2] & 4) << 3;                        // no mask, V' unused, length
  out[size++] = vex->opcode;
  out[size++] = mod == 1 ? (modrm & 0x3f) | 0x80 : modrm;  // EVEX scales a displacement of 8 bits, not one of 32
  memcpy(out + size, code + vex->modrm + 1, vex->length - vex->modrm - 1);
  if (mod != 1) return size + vex->length - vex->modrm - 1;
  size += vex->displacement - vex->modrm - 1;
  int32_t far = (int8_t)code[vex->displacement];
  memcpy(out + size, &far, 4);
  return size + 4;
}

static int fits(int64_t distance) { return distance == (int32_t)distance; }

// Copy one instruction to `out`; 0 when it has to stay where it is.
static int copy_one(const uint8_t *code, uint8_t *out, int *length) {
  Vex vex;
  if (!read_vex(code, &vex)) return 0;
  int product = is_product(code, &vex), size = product ? encode_evex(code, &vex, out) : vex.length;
  if (!product) memcpy(out, code, vex.length);
  *length = vex.length;
  if (!vex.relative) return size;
  int32_t before;
  memcpy(&before, code + vex.displacement, 4);
  int64_t distance = code + vex.length + before - (out + size);
  int32_t after = (int32_t)distance;
  memcpy(out + vex.displacement + (product ? 1 : 0), &after, 4);
  return fits(distance) ? size : 0;
}

static void jump(uint8_t *at, const uint8_t *to, uint8_t *written) {
  int32_t distance = (int32_t)(to - (at + JUMP));
  written[0] = 0xe9;
  memcpy(written + 1, &distance, 4);
}

typedef struct {
  uint8_t *next, *end;
} Area;

static Area areas[256];
static atomic_int busy;

static void enter(void) {
  while (atomic_exchange(&busy, 1)) sched_yield();
}
static void leave(void) { atomic_store(&busy, 0); }

static int within_a_jump(const uint8_t *one, const uint8_t *other) { return one - other < NEAR && other - one < NEAR; }

// Return an area with room for a copy that a jump from `code` reaches.
static Area *near(const uint8_t *code) {
  Area *area = areas;
  for (; area < areas + COUNT(areas) && area->next; area++)
    if (area->end - area->next > (COPIED + 1) * LONGEST && within_a_jump(area->next, code)) return area;
  if (area == areas + COUNT(areas)) return NULL;
  uintptr_t page = (uintptr_t)code & ~0xfffULL;
  for (intptr_t away = 16 << 20; away < NEAR; away = away > 0 ? -away : -away + (16 << 20)) {
    void *wanted = (void *)(page + away);
    int flags = MAP_PRIVATE | MAP_ANONYMOUS | MAP_FIXED_NOREPLACE;
    void *given = mmap(wanted, PAGES, PROT_READ | PROT_WRITE | PROT_EXEC, flags, -1, 0);
    if (given == wanted) {
      *area = (Area){given, (uint8_t *)given + PAGES};
      return area;
    }
    if (given != MAP_FAILED) munmap(given, PAGES);
  }
  return NULL;
}

static void every_core_sees_it(void) {
  if (!syscall(SYS_membarrier, MEMBARRIER_CMD_PRIVATE_EXPEDITED_SYNC_CORE, 0, 0)) return;
  syscall(SYS_membarrier, MEMBARRIER_CMD_REGISTER_PRIVATE_EXPEDITED_SYNC_CORE, 0, 0);
  syscall(SYS_membarrier, MEMBARRIER_CMD_PRIVATE_EXPEDITED_SYNC_CORE, 0, 0);
}

static void write_jump(uint8_t *code, const uint8_t *to) {
  uint8_t written[JUMP];
  jump(code, to, written);
  *(volatile uint8_t *)code = 0x06;  // illegal by itself: whoever meets it waits in replace()
  every_core_sees_it();
  memcpy(code + 1, written + 1, JUMP - 1);
  every_core_sees_it();
  *(volatile uint8_t *)code = written[0];
  every_core_sees_it();
}

static int make_writable(uint8_t *code) {
  uintptr_t first = (uintptr_t)code & ~0xfffULL, last = (uintptr_t)(code + JUMP - 1) & ~0xfffULL;
  return !mprotect((void *)first, last - first + 0x1000, PROT_READ | PROT_WRITE | PROT_EXEC);
}

static int copied(uint8_t *code) {
  Area *area = near(code);
  if (!area || !make_writable(code)) return 0;
  uint8_t *start = area->next, *out = start;
  const uint8_t *from = code;
  for (int i = 0, size, length; i < COPIED && (size = copy_one(from, out, &length)); i++) {
    out += size;
    from += length;
  }
  if (out == start) return 0;
  jump(out, from, out);
  area->next = out + JUMP;
  write_jump(code, start);
  return 1;
}

// Say whether the instruction at `code` is one that another thread has replaced meanwhile, or that is replaced now.
static int replaced(uint8_t *code) {
  Vex vex;
  enter();
  int done = *code == 0xe9 || (read_vex(code, &vex) && is_product(code, &vex) && copied(code));
  leave();
  return done;
}
