// Runs the sketch on a script: lines `MICROSECONDS TEXT` send TEXT, `MICROSECONDS @PIN VALUE` set a
// pin. At the end it prints the rising edges of both step pins.
#include "Arduino.h"
#include SKETCH

int main() {
  char text[200];
  unsigned long at;
  setup();
  while (scanf("%lu %199[^\n]", &at, text) == 2) {
    for (; now_us < at; now_us += 10) loop();
    int pin, value;
    if (sscanf(text, "@%d %d", &pin, &value) == 2) pins[pin] = value;
    else snprintf(input, sizeof input, "%s\n", text), unread = 0;
    loop();
  }
  printf("%ld %ld\n", edges[STEP[0]], edges[STEP[1]]);
}
