// FalconWing trainer bridge: commands from the computer in, pulses for the radio's trainer port out.
// Board: Arduino Mega 2560. Settings: config.h; wiring and tests: ../README.md.
//
//   pin 11  PPM out (OC1A)              the timer itself makes each edge; the interrupt only prepares the next one
//   pin 49  PPM in (ICP4)               the pilot's channels, if the radio outputs PPM
//   pin 19  Spektrum serial in (RX1)    the pilot's channels, from a remote receiver
//   pin 13  LED out                     on while ACTIVE; `falconwing bench` measures the camera's delay by it
//   USB     115200 8N1                  the computer
//   any     BUZZER_PIN                  an active buzzer that sounds in LOST, if set in config.h
//
// This file contains pins, registers and interrupts. All decisions are in safety, link, ppm_out and ppm_in, which do
// not depend on Arduino. "Data sheet" is ATmega640/1280/1281/2560/2561, Microchip DS40002211.
#include <avr/sleep.h>
#include <avr/wdt.h>
#include <util/atomic.h>

#include "config.h"
#include "link.h"
#include "ppm_in.h"
#include "ppm_out.h"
#include "safety.h"

constexpr uint8_t PPM_OUT_PIN = 11, PPM_IN_PIN = 49, SPEKTRUM_PIN = 19;
constexpr uint32_t STATUS_PERIOD_US = 1000000UL / STATUS_HZ;
constexpr uint8_t LARGEST_FRAME = 48;  // STATUS with eight channels; the core buffers 63 bytes
constexpr uint8_t HUNG_MS = 150;  // a pass of loop() takes well under 2 ms, a PPM frame 22
constexpr uint8_t HUNG_TICKS = 1000UL * HUNG_MS / FRAME_US;

// Shared with the interrupts: loop() touches these inside ATOMIC_BLOCK only.
Safety safety;
PpmOut ppm_out;
PilotPpm pilot_ppm;
volatile bool pilot_ppm_ready = false;  // to be sent to the host
Pilot pilot;                            // the newest frame of either source, for the next tick
volatile bool pilot_ready = false;
volatile uint8_t ticks_without_loop = 0;
volatile bool ticked = false;  // since loop() last fed the watchdog

// Used by loop() only.
Receiver receiver;
PilotSpektrum pilot_spektrum;
bool pilot_spektrum_ready = false;
SyncReply sync_reply;
bool sync_reply_ready = false;
uint32_t last_status_us = 0;

// ---- data that survive a reset: it does not change the RAM, and .noinit is not cleared at the start ----

uint8_t reset_cause __attribute__((section(".noinit")));
uint8_t boot_count __attribute__((section(".noinit")));
uint8_t hung __attribute__((section(".noinit")));  // loop() was hung when the reset came
uint16_t kept_check __attribute__((section(".noinit")));

// After a watchdog reset the watchdog still runs, at 15 ms, so it is stopped first; and the cause is
// cleared, else WDRF keeps the watchdog on (data sheet 12.5.1). .init3 runs before main() and before variables are set.
void take_reset_cause() __attribute__((naked, used, section(".init3")));
void take_reset_cause() {
  reset_cause = MCUSR;
  MCUSR = 0;
  wdt_disable();
}

uint16_t check_word() { return uint16_t(0x5AFE ^ (uint16_t(boot_count) << 8 | hung)); }

void keep(uint8_t new_boot_count, bool new_hung) {
  boot_count = new_boot_count;
  hung = new_hung;
  kept_check = check_word();
}

// Count this boot. Returns whether a hung loop() caused it. WDRF is not sufficient: the Mega's bootloader clears MCUSR
// before the sketch can read it, so the interrupt sets its own mark.
bool begin_kept() {
  const bool known = kept_check == check_word() && !(reset_cause & _BV(PORF));
  const bool stalled = (known && hung) || (reset_cause & _BV(WDRF));
  keep(known ? uint8_t(boot_count + 1) : 1, false);
  return stalled;
}

// ---- PPM out: Timer1, free running at 2 MHz (data sheet 17.8 compare match output unit, 17.9.1 normal mode) ----

// Action on the pin at the next match. COM1A1:0 = 3 sets it, 2 clears it.
constexpr uint8_t SET_PIN = _BV(COM1A1) | _BV(COM1A0), CLEAR_PIN = _BV(COM1A1);
constexpr uint8_t TO_IDLE = POLARITY ? SET_PIN : CLEAR_PIN, TO_PULSE = POLARITY ? CLEAR_PIN : SET_PIN;

// TIMSK1 and TCCR1B while pulses are made: interrupt at each match; normal mode, 16 MHz / 8.
constexpr uint8_t PPM_OUT_INTERRUPTS = _BV(OCIE1A), PPM_OUT_CLOCK = _BV(CS11);

void begin_ppm_out() {
  TCCR1B = 0;  // stop: the core has configured the timer for analogWrite()
  TCCR1A = TO_IDLE;
  TCCR1C = _BV(FOC1A);  // force a match, so that the pin begins idle
  pinMode(PPM_OUT_PIN, OUTPUT);
  TCNT1 = 0;
  OCR1A = FRAME_US * uint16_t(TICKS_PER_US);
  TIFR1 = _BV(OCF1A);
  TIMSK1 = PPM_OUT_INTERRUPTS;
  TCCR1B = PPM_OUT_CLOCK;
}

// If loop() hangs, the safety machine gets no commands and outputs the safe slots; then the watchdog resets the
// board. The mark records the reason for the next boot; a loop() that returns in time clears it.
void watch_loop() {
  if (ticks_without_loop < HUNG_TICKS) ++ticks_without_loop;
  const bool hangs = ticks_without_loop == HUNG_TICKS;
  if (hangs != hung) keep(boot_count, hangs);
}

// An edge has just been made. The next is at least GAP_PULSE_US away, which is sufficient: with eight channels and a
// full serial line this begins at most 60 us late (atomic blocks, other interrupts) and takes at most 120 us (measured
// in the simulated chip).
ISR(TIMER1_COMPA_vect) {
  if (ppm_out.at_frame_start()) {
    safety.tick(micros(), pilot_ready ? &pilot : nullptr);
    pilot_ready = false;
    ticked = true;
    watch_loop();
  }
  const PpmOut::Edge edge = ppm_out.next(safety.slots_us(), safety.silent());
  TCCR1A = edge.pulse ? TO_PULSE : TO_IDLE;  // before OCR1A: simavr 1.6 acts on a write to OCR1A
  OCR1A += edge.after_ticks;
}

// ---- PPM in: Timer4 copies its count at each falling edge (data sheet 17.6 input capture unit) ----

// Falling edges serve both polarities: the time between the ends of two pulses is also a slot.
constexpr uint8_t PPM_IN_INTERRUPTS = PILOT_SOURCE != 1 ? _BV(ICIE4) : 0;
constexpr uint8_t PPM_IN_CLOCK = _BV(ICNC4) | _BV(CS41);  // noise canceller, falling edge, 16 MHz / 8

void begin_ppm_in() {
  pinMode(PPM_IN_PIN, INPUT_PULLUP);  // an open pin must not pick up noise
  TCCR4A = 0;
  TCCR4B = PPM_IN_CLOCK;
  TIFR4 = _BV(ICF4);
  TIMSK4 = PPM_IN_INTERRUPTS;
}

ISR(TIMER4_CAPT_vect) {
  const uint16_t capture = ICR4;
  const uint16_t age = TCNT4 - capture;
  if (!pilot_ppm.edge(capture, micros() - age / TICKS_PER_US)) return;
  pilot = pilot_ppm.pilot;
  pilot_ready = pilot_ppm_ready = true;
}

// The newest frame of either source goes to the next tick, which compares the sticks.
void take_spektrum(uint8_t byte) {
  if (!pilot_spektrum.byte(byte, micros(), CHANNELS)) return;
  pilot_spektrum_ready = true;
  ATOMIC_BLOCK(ATOMIC_RESTORESTATE) {
    pilot = pilot_spektrum.pilot;
    pilot_ready = true;
  }
}

// ---- against disturbed registers and memory ----

// The watchdog restarts the board 250 ms after the pulse interrupt or loop() has stopped: only loop() feeds it, and
// only if the pulse interrupt has run since. The mark records the reason for the next boot (begin_kept).
void feed_watchdog() {
  static uint16_t fed_ms = 0;
  const uint16_t now_ms = uint16_t(millis());
  if (ticked) {
    ticked = false;
    fed_ms = now_ms;
    wdt_reset();
  } else if (uint16_t(now_ms - fed_ms) > HUNG_MS) {
    keep(boot_count, true);
  }
}

void hold(volatile uint8_t& reg, uint8_t value) {
  if (reg != value) reg = value;
}

// Registers are set once and would keep a disturbance for good, so every pass of loop() sets them again.
void hold_registers() {
  pinMode(PPM_OUT_PIN, OUTPUT);
  hold(TIMSK1, PPM_OUT_INTERRUPTS);
  hold(TCCR1B, PPM_OUT_CLOCK);
  hold(TIMSK0, _BV(TOIE0));  // the core's clock, micros()
  hold(TCCR0A, _BV(WGM01) | _BV(WGM00));
  hold(TCCR0B, _BV(CS01) | _BV(CS00));
  hold(TIMSK4, PPM_IN_INTERRUPTS);
  if (PPM_IN_INTERRUPTS != 0) {
    hold(TCCR4A, 0);
    hold(TCCR4B, PPM_IN_CLOCK);
  }
}

// An interrupt that nobody has enabled: only a reset sets the registers of the whole chip right.
ISR(BADISR_vect) {
  wdt_enable(WDTO_15MS);
  wdt_reset();  // simavr 1.6 takes the new time from here on
  for (;;) {
  }
}

// ---- serial in ----

void take_command(const Command& command) {
  Verdict verdict;
  ATOMIC_BLOCK(ATOMIC_RESTORESTATE) {
    verdict = safety.frame(micros(), command.sequence, command.engage(), command.channels_us, command.n);
  }
  if (verdict == Verdict::FORM) ++receiver.bad;
}

void take_byte(uint8_t byte) {
  const uint8_t size = receiver.feed(byte);
  if (size == 0) return;
  Command command;
  Sync sync;
  if (decode(receiver.payload(), size, &command)) {
    take_command(command);
  } else if (decode(receiver.payload(), size, &sync)) {
    sync_reply.token = sync.token;
    sync_reply.received_us = micros();
    sync_reply_ready = true;
  } else {
    ++receiver.bad;
  }
}

// ---- serial out: one message per pass, and only if the buffer has room for all of it, so loop() never waits ----

uint8_t frame[MAX_FRAME + 1];

void send_sync_reply() {
  sync_reply.sent_us = micros();
  sync_reply_ready = false;
  Serial.write(frame, encode(sync_reply, frame));
}

void send_status() {
  Status status;
  ATOMIC_BLOCK(ATOMIC_RESTORESTATE) {
    status.state = uint8_t(safety.state());
    status.fault = uint8_t(safety.fault());
    status.flags = uint8_t((safety.silent() ? Status::SILENT : 0) | (safety.has_pilot() ? Status::HAS_PILOT : 0) |
                           (safety.pilot_took_over() ? Status::PILOT_TOOK_OVER : 0) |
                           (ENGAGE_WITHOUT_PILOT ? Status::ENGAGES_WITHOUT_PILOT : 0));
    status.ppm_frames = ppm_out.frames();
    for (uint8_t i = 0; i < CHANNELS; ++i) status.channels_us[i] = safety.slots_us()[i];
  }
  status.version = PROTOCOL_VERSION;
  status.device_time_us = last_status_us = micros();
  status.boot_count = boot_count;
  status.reset_cause = reset_cause;
  status.last_sequence = safety.last_sequence();  // from here on only loop() writes
  status.accepted = safety.accepted();
  status.bad_frames = receiver.bad;
  status.bad_sequence = safety.bad_sequence();
  status.out_of_range = safety.out_of_range();
  status.n = CHANNELS;
  Serial.write(frame, encode(status, frame));
}

void send_pilot_ppm() {
  Pilot message;
  ATOMIC_BLOCK(ATOMIC_RESTORESTATE) {
    message = pilot_ppm.pilot;
    pilot_ppm_ready = false;
  }
  Serial.write(frame, encode(message, frame));
}

void send_pilot_spektrum() {
  pilot_spektrum_ready = false;
  Serial.write(frame, encode(pilot_spektrum.pilot, frame));
}

void tell_host() {
  if (Serial.availableForWrite() < LARGEST_FRAME) return;
  if (micros() - last_status_us >= STATUS_PERIOD_US) send_status();
  else if (sync_reply_ready) send_sync_reply();
  else if (pilot_ppm_ready) send_pilot_ppm();
  else if (pilot_spektrum_ready) send_pilot_spektrum();
}

// ---- the program ----

// The LED on pin 13 is PB7. One instruction each: the interrupts are not held up, as digitalWrite() would do.
void show_active() {
  if (safety.state() == State::ACTIVE) PORTB |= _BV(PB7);
  else PORTB &= ~_BV(PB7);
}

// Sleep until the next interrupt, at most 1 ms (the clock's). sei() executes the next instruction before any
// interrupt, so no byte is missed between the check and the sleep (data sheet 7.8 and 11.2 idle mode).
void nap() {
  cli();
  if (!Serial.available() && !Serial1.available()) {
    set_sleep_mode(SLEEP_MODE_IDLE);  // each time: a disturbed register could stop the timers
    sleep_enable();
    sei();
    sleep_cpu();
    sleep_disable();
  }
  sei();
}

void setup() {
  const bool stalled = begin_kept();
  safety.begin(micros(), stalled);
  Serial.begin(115200);
  if (PILOT_SOURCE != 1) begin_ppm_in();
  if (PILOT_SOURCE != 0) Serial1.begin(115200);
  pinMode(SPEKTRUM_PIN, INPUT_PULLUP);
  DDRB |= _BV(PB7);
  begin_ppm_out();
  if (BUZZER_PIN != 0) pinMode(BUZZER_PIN, OUTPUT);
  wdt_enable(WDTO_250MS);
}

void loop() {
  feed_watchdog();
  hold_registers();
  ticks_without_loop = 0;
  for (int n = Serial.available(); n > 0; --n) take_byte(uint8_t(Serial.read()));
  for (int n = Serial1.available(); n > 0; --n) take_spektrum(uint8_t(Serial1.read()));
  show_active();
  tell_host();
  if (BUZZER_PIN != 0) digitalWrite(BUZZER_PIN, safety.state() == State::LOST && (millis() & 256));
  nap();
}
