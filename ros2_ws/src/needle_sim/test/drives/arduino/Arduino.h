// Stand-in for the Arduino core: simulated time, pins and serial port for one sketch.
#include <math.h>
#include <stdint.h>
#include <stdio.h>
#include <stdlib.h>
#include <string.h>

enum { LOW, HIGH, OUTPUT, INPUT_PULLUP };
#define constrain(x, low, high) ((x) < (low) ? (low) : (x) > (high) ? (high) : (x))

unsigned long now_us = 0;
int pins[20];
long edges[20];
char input[4096];
size_t unread = 0;

unsigned long micros() { return now_us; }
void delayMicroseconds(unsigned) {}
void pinMode(int, int) {}
int digitalRead(int pin) { return pins[pin]; }
void digitalWrite(int pin, int value) {
  edges[pin] += value && !pins[pin];
  pins[pin] = value;
}

struct {
  void begin(long) {}
  int available() { return input[unread] != 0; }
  char read() { return input[unread++]; }
  void print(const char *text) { fputs(text, stdout); }
} Serial;
