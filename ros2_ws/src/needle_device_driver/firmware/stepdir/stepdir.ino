// Step/direction board for insertion (axis 0) and rotation (axis 1), over USB serial, 115200 baud.
// A line is $NUMBER,LETTER[,VALUE...]*HH and a line feed; HH is the XOR of the characters between
// $ and *, as two hexadecimal digits. NUMBER counts the lines, 0..255, and an answer repeats it.
//   I                          identify; answer: NAME,VERSION,MAX_RATE [steps/s]
//   C,AXIS,DECELERATION,OUTER,TIME  set up: ramp [steps/s^2], direction of the outer switch (1, -1)
//                              and time of the dead-man, 50..500 ms; 100 ms after power-up
//   P,AXIS,0|1                 motor off or on; no answer, as of M, H and B
//   M,AXIS,POSITION,TIME       be at a position [steps since power-up] in a time [ms]; stop there
//   H,AXIS                     brake and forget the target
//   B                          beat, for the dead-man
//   R                          reset the fault
//   S                          answer: FAULT,POSITION,FLAGS,POSITION,FLAGS of axes 0 and 1
// FLAGS: 1 on, 2 moving, 4 outer switch, 8 inner switch, 16 set up since power-up.
// FAULT: 1 no valid line for TIME, 2 a line was lost or came from elsewhere: NUMBER did not
// follow. With a motor on, either brakes both axes; they hold their place until R. A line that is
// damaged or unknown is dropped without an answer.
const char NAME[] = "stepdir,1";
#ifdef __AVR__
const long MAX_RATE = 10000;           // steps/s of each axis; estimated, not measured
#else
const long MAX_RATE = 100000;
#endif
const unsigned long TICK = 1000;       // us
const uint8_t STEP[] = {2, 5}, DIR[] = {3, 6}, ENABLE[] = {4, 7};  // pins of each axis
const uint8_t OUTER[] = {8, 10}, INNER[] = {9, 11};
const bool HAS_SWITCHES[] = {true, false};  // normally closed to ground: a broken cable is active
struct Axis {
  long at, target;
  float speed, rate, ramp;
  unsigned long phase;
  int outer;
  bool on, go;
};
Axis axes[2];
int fault = 0, expected = -1;
unsigned long fed, passed, ticked, deadMan = 100000;  // us
char line[64];
uint8_t length = 0;

bool active(int a, const uint8_t *pins) { return HAS_SWITCHES[a] && digitalRead(pins[a]); }

void fail(int code) {
  if (fault || !(axes[0].on || axes[1].on)) return;
  fault = code;
  axes[0].go = axes[1].go = false;
}

void answer(int number, char letter, const char *text) {
  char body[64];
  int n = snprintf(body, sizeof body, "%d,%c%s", number, letter, text);
  uint8_t sum = 0;
  for (int i = 0; i < n; i++) sum ^= body[i];
  char out[72];
  snprintf(out, sizeof out, "$%s*%02X\n", body, sum);
  Serial.print(out);
}

void execute() {  // one line, without its line feed
  char *star = strchr(line, '*'), letter, text[48] = "";
  if (line[0] != '$' || !star || strlen(star) != 3) return;
  uint8_t sum = 0;
  for (char *c = line + 1; c < star; c++) sum ^= *c;
  if (strtol(star + 1, 0, 16) != sum) return;
  *star = 0;
  int number, used = 0, count = 0;
  if (sscanf(line + 1, "%d,%c%n", &number, &letter, &used) != 2 || !used) return;
  long value[4] = {0, 0, 0, 0};
  for (char *c = line + 1 + used; *c == ',' && count < 4;) value[count++] = strtol(c + 1, &c, 10);
  if (expected >= 0 && number != expected) fail(2);
  expected = (number + 1) & 255;
  fed = micros();
  Axis &axis = axes[value[0] == 1];
  if (letter == 'I') snprintf(text, sizeof text, ",%s,%ld", NAME, MAX_RATE);
  else if (letter == 'R') fault = 0;
  else if (letter == 'C') {
    if (value[1] <= 0) return;
    axis.ramp = value[1], axis.outer = value[2] > 0 ? 1 : -1;
    deadMan = constrain(value[3], 50, 500) * 1000UL;
  }
  else if (letter == 'P') {
    bool on = value[1] && axis.ramp && !fault;
    if (on != axis.on) axis.on = on, axis.go = false, axis.rate = 0;
    digitalWrite(ENABLE[value[0] == 1], !on);
  } else if (letter == 'M' && axis.on && !fault) {
    axis.target = value[1], axis.go = true;
    axis.speed = fmin(labs(axis.target - axis.at) * 1000.0 / fmax(value[2], 1), MAX_RATE);
  } else if (letter == 'H') axis.go = false;
  else if (letter == 'S') {
    int n = snprintf(text, sizeof text, ",%d", fault);
    for (int a = 0; a < 2; a++) {
      Axis &x = axes[a];
      bool moving = x.rate != 0 || (x.go && x.at != x.target);
      n += snprintf(text + n, sizeof text - n, ",%ld,%d", x.at, x.on + 2 * moving
                    + 4 * active(a, OUTER) + 8 * active(a, INNER) + 16 * (x.ramp != 0));
    }
  }
  if (strchr("IRCS", letter)) answer(number, letter, text);
}

void tick(int a) {  // the rate of the next millisecond: at most the ramp faster or slower
  Axis &x = axes[a];
  long left = x.target - x.at;
  if (x.go && active(a, left * x.outer > 0 ? OUTER : INNER)) x.go = false;
  float change = x.ramp * TICK * 1e-6, want = 0;
  float ending = (sqrt(change * change + 8 * x.ramp * labs(left)) - change) / 2;  // stops there
  if (x.go) want = copysign(fmin(x.speed, ending), left);
  if (!left && fabs(x.rate) <= 2 * change) want = x.rate = 0;
  x.rate += constrain(want - x.rate, -change, change);
}

void step(int a, unsigned long us) {
  Axis &x = axes[a];
  x.phase = x.rate && x.on ? x.phase + (unsigned long)fabs(x.rate) * us : 0;
  if (x.phase < 1000000UL) return;
  x.phase -= 1000000UL;
  digitalWrite(DIR[a], x.rate > 0);
  digitalWrite(STEP[a], HIGH);
  x.at += x.rate > 0 ? 1 : -1;
  delayMicroseconds(2);
  digitalWrite(STEP[a], LOW);
}

void setup() {
  Serial.begin(115200);
  for (int a = 0; a < 2; a++) {
    digitalWrite(ENABLE[a], HIGH);  // active low: off
    pinMode(STEP[a], OUTPUT), pinMode(DIR[a], OUTPUT), pinMode(ENABLE[a], OUTPUT);
    pinMode(OUTER[a], INPUT_PULLUP), pinMode(INNER[a], INPUT_PULLUP);
  }
}

void loop() {
  while (Serial.available()) {
    char c = Serial.read();
    if (c == '\n') line[length] = 0, length = 0, execute();
    else if (length < sizeof line - 1) line[length++] = c;
  }
  unsigned long now = micros();
  if (now - fed > deadMan) fail(1);
  if (now - ticked >= TICK) ticked = now, tick(0), tick(1);
  step(0, now - passed), step(1, now - passed);
  passed = now;
}
