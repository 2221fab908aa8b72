// A library of the environment's own that asks CPUID, confined as all others are: what it sees, all of them see.
#include <cpuid.h>

void ask(unsigned leaf, unsigned subleaf, unsigned found[4]) {
  __cpuid_count(leaf, subleaf, found[0], found[1], found[2], found[3]);
}
