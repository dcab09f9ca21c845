/* What the examples share: reading a CSV file, and a report of times. */
#ifndef COMMON_H
#define COMMON_H
#include <stdio.h>
#include <stdlib.h>
#include <string.h>

enum { LONGEST_LINE = 1 << 16 };

/* Whether a line is one of names: its first entry is no number. */
static int has_names(const char* line) {
  char* end;
  strtod(line, &end);
  return end == line || strchr(",; \t\r\n", *end) == NULL;
}

/* Reads all rows of `columns` numbers, after a line of names if there is one. Returns how many there are, or -1. */
static long read_rows(const char* path, size_t columns, double** rows) {
  static char line[LONGEST_LINE];
  long count = 0, names = 0;
  size_t room = 0;
  FILE* file = fopen(path, "r");
  *rows = NULL;
  if (!file) {
    fprintf(stderr, "%s: expected a file that can be read\n", path);
    return -1;
  }
  while (fgets(line, sizeof line, file)) {
    char* at = line;
    if (line[strspn(line, " \t\r\n")] == '\0') continue; /* an empty line, as at the end */
    if (count + names == 0 && has_names(line)) {
      names = 1;
      continue;
    }
    if ((size_t)++count > room) {
      double* larger = realloc(*rows, (room = 2 * (size_t)count) * columns * sizeof(double));
      if (!larger) break;
      *rows = larger;
    }
    for (size_t i = 0; i < columns; i++) {
      char* end;
      (*rows)[(size_t)(count - 1) * columns + i] = strtod(at, &end);
      if (end == at) {
        fprintf(stderr, "%s: expected %zu numbers in row %ld, got %zu\n", path, columns, count, i);
        fclose(file);
        return -1;
      }
      at = end + (*end == ',');
    }
    if (at[strspn(at, " \t\r\n")] != '\0') {
      fprintf(stderr, "%s: expected %zu numbers in row %ld, got more\n", path, columns, count);
      fclose(file);
      return -1;
    }
  }
  fclose(file);
  if (count < 1) fprintf(stderr, "%s: expected rows of %zu numbers\n", path, columns);
  return count;
}

static int ascending(const void* a, const void* b) {
  const double x = *(const double*)a, y = *(const double*)b;
  return (x > y) - (x < y);
}

/* Prints the distribution of some times, which it sorts. */
static void report(const char* what, double* seconds, long count) {
  double sum = 0;
  for (long i = 0; i < count; i++) sum += seconds[i];
  qsort(seconds, (size_t)count, sizeof(double), ascending);
  printf("%s [us]: p50 %.1f, p99 %.1f, largest %.1f, mean %.1f\n", what, 1e6 * seconds[count / 2],
         1e6 * seconds[count * 99 / 100], 1e6 * seconds[count - 1], 1e6 * sum / (double)count);
}

#endif
