// Stands in for the Python of a confined environment: starts the real one with hide.c loaded before anything else.
// PYTHON and PRELOADED are defined when it is compiled.
#include <errno.h>
#include <stdio.h>
#include <stdlib.h>
#include <string.h>
#include <unistd.h>

int main(int count, char **words) {
  (void)count;
  const char *before = getenv("LD_PRELOAD");
  size_t room = strlen(PRELOADED) + (before ? strlen(before) : 0) + 2;
  char *all = malloc(room);
  if (access(PRELOADED, R_OK) == 0 && all) {
    snprintf(all, room, "%s%s%s", PRELOADED, before && *before ? ":" : "", before ? before : "");
    setenv("LD_PRELOAD", all, 1);
    execv(PYTHON, words);
  }
  fprintf(stderr, "%s: this environment is confined, and %s with %s does not start: %s\n", words[0], PYTHON, PRELOADED,
          strerror(errno));
  return 127;
}
