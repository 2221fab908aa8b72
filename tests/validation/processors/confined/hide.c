// Loaded before every other library of a confined environment (by launch.c): answers the instructions that stand where
// CPUID stood, without the features that are hidden, and shows /proc/cpuinfo without them; AVX-VNNI is added where it is
// wanted and the host has AVX512-VNNI. hidden.h is written by _confined.py: ANY, PRELOADED, AVX_VNNI (whether to add it),
// hidden[] (leaf, subleaf, bits of eax, ebx, ecx, edx) and names[].
#define _GNU_SOURCE
#include <cpuid.h>
#include <dlfcn.h>
#include <fcntl.h>
#include <pthread.h>
#include <signal.h>
#include <stdarg.h>
#include <stdio.h>
#include <stdlib.h>
#include <string.h>
#include <sys/mman.h>
#include <ucontext.h>
#include <unistd.h>

#include "hidden.h"

#define COUNT(array) (sizeof(array) / sizeof *(array))

#include "avx_vnni.h"

// ---- The functions of libc that stand behind ours: found before main(), since dlsym() waits for a thread that loads

int __open_2(const char *, int);
int __open64_2(const char *, int);

#define WRAPPED(each)                                                                                        \
  each(sigaction) each(signal) each(pthread_sigmask) each(sigprocmask) each(open) each(open64) each(openat) \
  each(openat64) each(__open_2) each(__open64_2) each(fopen) each(fopen64)
#define DECLARE(name) static __typeof__(&name) libc_##name;
#define NEXT(name) (libc_##name ? libc_##name : (libc_##name = (__typeof__(&name))dlsym(RTLD_NEXT, #name)))
#define FIND(name) (void)NEXT(name);

WRAPPED(DECLARE)

// ---- CPUID

static struct sigaction others;  // what the program wants to happen at every other illegal instruction

static void answer(greg_t *registers) {
  unsigned leaf = (unsigned)registers[REG_RAX], subleaf = (unsigned)registers[REG_RCX], found[4];
  __cpuid_count(leaf, subleaf, found[0], found[1], found[2], found[3]);
  for (size_t i = 0; i < COUNT(hidden); i++)
    if (hidden[i].leaf == leaf && (hidden[i].subleaf == subleaf || hidden[i].subleaf == ANY))
      for (int k = 0; k < 4; k++) found[k] &= ~hidden[i].bits[k];
  if (AVX_VNNI && leaf == 7 && subleaf == 0 && !found[0]) found[0] = 1;  // the last subleaf
  if (AVX_VNNI && leaf == 7 && subleaf == 1) found[0] |= 1 << 4;
  registers[REG_RAX] = found[0];
  registers[REG_RBX] = found[1];
  registers[REG_RCX] = found[2];
  registers[REG_RDX] = found[3];
  registers[REG_RIP] += 2;
}

static void die(int sent) {
  struct sigaction usual = {.sa_handler = SIG_DFL};
  NEXT(sigaction)(SIGILL, &usual, NULL);
  if (sent) raise(SIGILL);  // otherwise the instruction is met again
}

static void on_illegal(int number, siginfo_t *info, void *context) {
  greg_t *registers = ((ucontext_t *)context)->uc_mcontext.gregs;
  int sent = info->si_code <= 0;  // by kill or raise, not by the processor
  if (!sent && !memcmp((const void *)registers[REG_RIP], "\x0f\x04", 2))
    answer(registers);
  else if (!sent && AVX_VNNI && replaced((uint8_t *)registers[REG_RIP]))
    return;
  else if (others.sa_flags & SA_SIGINFO)
    others.sa_sigaction(number, info, context);
  else if (others.sa_handler == SIG_DFL || (others.sa_handler == SIG_IGN && !sent))
    die(sent);
  else if (others.sa_handler != SIG_IGN)
    others.sa_handler(number);
}

__attribute__((constructor)) static void start(void) {
  WRAPPED(FIND)
  // without SA_ONSTACK: such a stack is that of others, who free it
  struct sigaction ours = {.sa_sigaction = on_illegal, .sa_flags = SA_SIGINFO | SA_NODEFER | SA_RESTART};
  NEXT(sigaction)(SIGILL, &ours, &others);
  pthread_atfork(enter, leave, leave);
  const char *words = getenv("LD_PRELOAD");  // launch.c put this library first: children that are other programs go without
  if (!words || strncmp(words, PRELOADED, strlen(PRELOADED))) return;
  const char *rest = words + strlen(PRELOADED);
  if (*rest == ':') setenv("LD_PRELOAD", strdup(rest + 1), 1);
  if (!*rest) unsetenv("LD_PRELOAD");
}

// ---- Who takes SIGILL (faulthandler does) is asked after us; who blocks it (threads of libraries do) leaves it open

int sigaction(int number, const struct sigaction *wanted, struct sigaction *before) {
  if (number != SIGILL) return NEXT(sigaction)(number, wanted, before);
  struct sigaction was = others;
  if (wanted) others = *wanted;
  if (before) *before = was;
  return 0;
}

sighandler_t signal(int number, sighandler_t handler) {
  if (number != SIGILL) return NEXT(signal)(number, handler);
  struct sigaction wanted = {.sa_handler = handler}, before;
  sigaction(SIGILL, &wanted, &before);
  return before.sa_handler;
}

static const sigset_t *open_to_us(const sigset_t *set, sigset_t *copy) {
  if (!set) return NULL;
  *copy = *set;
  sigdelset(copy, SIGILL);
  return copy;
}

int pthread_sigmask(int how, const sigset_t *set, sigset_t *before) {
  sigset_t copy;
  return NEXT(pthread_sigmask)(how, open_to_us(set, &copy), before);
}

int sigprocmask(int how, const sigset_t *set, sigset_t *before) {
  sigset_t copy;
  return NEXT(sigprocmask)(how, open_to_us(set, &copy), before);
}

// ---- /proc/cpuinfo

static int is_hidden(const char *word, size_t length) {
  for (size_t i = 0; i < COUNT(names); i++)
    if (strlen(names[i]) == length && !memcmp(word, names[i], length)) return 1;
  return 0;
}

static void write_line(FILE *out, char *line) {
  if (strncmp(line, "flags", 5)) {
    fputs(line, out);
    return;
  }
  char *left = strchr(line, ':'), *word;
  fprintf(out, "%.*s", (int)(left ? left + 1 - line : 0), line);
  for (left = left ? strtok_r(left + 1, " \n", &word) : NULL; left; left = strtok_r(NULL, " \n", &word))
    if (!is_hidden(left, strlen(left))) fprintf(out, " %s", left);
  if (AVX_VNNI) fputs(" avx_vnni", out);
  fputc('\n', out);
}

static int masked(void) {
  FILE *real = NEXT(fopen)("/proc/cpuinfo", "re");
  int file = memfd_create("cpuinfo", MFD_CLOEXEC);
  FILE *out = file < 0 ? NULL : fdopen(dup(file), "w");
  char *line = NULL;
  size_t room = 0;
  while (real && out && getline(&line, &room, real) >= 0) write_line(out, line);
  free(line);
  if (real) fclose(real);
  if (out) fclose(out);
  lseek(file, 0, SEEK_SET);
  return file;
}

static int is_cpuinfo(const char *path) { return path && !strcmp(path, "/proc/cpuinfo"); }

static int mode_of(int flags, va_list more) { return flags & (O_CREAT | __O_TMPFILE) ? va_arg(more, int) : 0; }

#define OPEN(name)                                                            \
  int name(const char *path, int flags, ...) {                                \
    va_list more;                                                             \
    va_start(more, flags);                                                    \
    int mode = mode_of(flags, more);                                          \
    va_end(more);                                                             \
    return is_cpuinfo(path) ? masked() : NEXT(name)(path, flags, mode);       \
  }
#define OPENAT(name)                                                          \
  int name(int folder, const char *path, int flags, ...) {                    \
    va_list more;                                                             \
    va_start(more, flags);                                                    \
    int mode = mode_of(flags, more);                                          \
    va_end(more);                                                             \
    return is_cpuinfo(path) ? masked() : NEXT(name)(folder, path, flags, mode); \
  }
#define CHECKED(name)                                                         \
  int name(const char *path, int flags) { return is_cpuinfo(path) ? masked() : NEXT(name)(path, flags); }
#define FOPEN(name)                                                           \
  FILE *name(const char *path, const char *mode) {                            \
    return is_cpuinfo(path) ? fdopen(masked(), mode) : NEXT(name)(path, mode); \
  }

OPEN(open)
OPEN(open64)
OPENAT(openat)
OPENAT(openat64)
CHECKED(__open_2)
CHECKED(__open64_2)
FOPEN(fopen)
FOPEN(fopen64)
