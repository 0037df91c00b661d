// All settings that depend on the radio.
//
// None of these numbers was measured on a Spektrum NX8: measure yours first (README, "Measure the radio").
// Each may also be set by the compiler: make -C firmware elf DEFINES="-DCHANNELS=8 -DPOLARITY=0"
#pragma once
#include <stdint.h>

// ---- the pulses that leave on pin 11 ----
#ifndef CHANNELS
#define CHANNELS 4  // slots in a frame, 4..8; the host sets the channel order (hardware/trainer_port.toml)
#endif
#ifndef FRAME_US
#define FRAME_US 22000  // first edge of a frame to the first edge of the next; radios use 20000 to 22500
#endif
#ifndef GAP_PULSE_US
#define GAP_PULSE_US 400  // the short pulse that begins each slot and ends the last; radios use 300 to 400
#endif
#ifndef POLARITY
#define POLARITY 1  // at the pin. 1: idle high, short pulses low. 0: idle low, short pulses high.
#endif

// ---- limits of a slot ----
#ifndef CHANNEL_MIN_US
#define CHANNEL_MIN_US 1000  // lower commands are clipped to this
#endif
#ifndef CHANNEL_MAX_US
#define CHANNEL_MAX_US 2000  // higher commands are clipped to this
#endif
#ifndef VALID_MIN_US
#define VALID_MIN_US 900  // a frame with a lower command is refused
#endif
#ifndef VALID_MAX_US
#define VALID_MAX_US 2100  // a frame with a higher command is refused
#endif
#ifndef THROTTLE_CHANNEL
#define THROTTLE_CHANNEL 0  // index of the throttle's slot, from 0
#endif
#ifndef THROTTLE_CEILING_US
#define THROTTLE_CEILING_US 2000  // lower it for the first flights
#endif
#ifndef SLEW_US
#define SLEW_US 250  // maximum change of a slot from one frame to the next: full travel in four frames
#endif
#ifndef SAFE_SLOTS_US
#define SAFE_SLOTS_US 1000, 1500, 1500, 1500, 1500, 1500, 1500, 1500  // throttle idle, others neutral; trims go here
#endif

// ---- engagement and failsafe ----
#ifndef HOST_TIMEOUT_MS
#define HOST_TIMEOUT_MS 200  // timeout of valid commands: safe slots. The host sends every 50 ms.
#endif
#ifndef ENGAGE_FRAMES
#define ENGAGE_FRAMES 5  // consecutive valid commands with engage before the board follows
#endif
#ifndef ENGAGE_WINDOW_MS
#define ENGAGE_WINDOW_MS 500  // and all of them within this time
#endif
#ifndef ENGAGE_NEAR_US
#define ENGAGE_NEAR_US 100  // engage only within this of the pilot's slots, or of neutral where none are measured
#endif
#ifndef ENGAGE_IDLE_US
#define ENGAGE_IDLE_US 20  // and of idle, for the throttle where no pilot is measured
#endif
#ifndef ENGAGE_WITHOUT_PILOT
#define ENGAGE_WITHOUT_PILOT 0  // 1: engage at any command where no pilot is measured; STATUS says so
#endif
#ifndef PILOT_MOVED_US
#define PILOT_MOVED_US 120  // a pilot's slot further from where it was at the engagement: SAFE. 12 % of 1000 us.
#endif
#ifndef PILOT_FRESH_MS
#define PILOT_FRESH_MS 100  // a pilot's frame older than this is no measurement; radios send one every 11 to 22 ms
#endif
#ifndef SILENT_AFTER_MS
#define SILENT_AFTER_MS 0  // timeout of valid commands: no pulses, for radios that detect this. 0: never.
#endif
#ifndef RANGE_FAULT_FRAMES
#define RANGE_FAULT_FRAMES 5  // commands out of range within a second that lead to FAULT
#endif

#ifndef BUZZER_PIN
#define BUZZER_PIN 0  // an active buzzer on this pin sounds twice a second while the host is LOST. 0: none.
#endif

// ---- messages to the host ----
#ifndef STATUS_HZ
#define STATUS_HZ 20
#endif
#ifndef PILOT_SOURCE
#define PILOT_SOURCE 2  // the pilot's channels: 0: PPM on pin 49, 1: Spektrum serial on pin 19, 2: either
#endif
#ifndef SPEKTRUM_2048
#define SPEKTRUM_2048 1  // 1: positions 0..2047 (all current radios), 0: positions 0..1023 (old DSM2, 22 ms)
#endif

constexpr uint16_t SAFE_US[8] = {SAFE_SLOTS_US};

// The safe slot of a channel, as numbers in the code: the chip keeps a table in its memory, where a bit may flip.
inline uint16_t safe_us(uint8_t channel) {
  return channel == 0   ? SAFE_US[0]
         : channel == 1 ? SAFE_US[1]
         : channel == 2 ? SAFE_US[2]
         : channel == 3 ? SAFE_US[3]
         : channel == 4 ? SAFE_US[4]
         : channel == 5 ? SAFE_US[5]
         : channel == 6 ? SAFE_US[6]
                        : SAFE_US[7];
}

// ---- combinations that cannot work do not compile ----
constexpr int32_t SHORTEST_SYNC_US = int32_t(FRAME_US) - int32_t(CHANNELS) * CHANNEL_MAX_US;
constexpr int32_t LONGEST_SYNC_US = int32_t(FRAME_US) - int32_t(CHANNELS) * CHANNEL_MIN_US;
constexpr bool safe_from(int channel) {
  return channel == CHANNELS ||
         (SAFE_US[channel] >= CHANNEL_MIN_US && SAFE_US[channel] <= CHANNEL_MAX_US && safe_from(channel + 1));
}
static_assert(CHANNELS >= 4 && CHANNELS <= 8, "CHANNELS: 4 to 8 slots");
static_assert(SHORTEST_SYNC_US >= 4000, "the pause is under 4 ms: reduce CHANNELS or increase FRAME_US");
static_assert(LONGEST_SYNC_US <= 19000, "the pause is over 19 ms: reduce FRAME_US");
static_assert(FRAME_US <= 32000, "FRAME_US: the 16 bit timer counts to 32.7 ms");
static_assert(GAP_PULSE_US >= 250 && GAP_PULSE_US + 250 <= CHANNEL_MIN_US,
              "GAP_PULSE_US: the interrupt needs 250 us between two edges");
static_assert(VALID_MIN_US <= CHANNEL_MIN_US && CHANNEL_MIN_US < CHANNEL_MAX_US && CHANNEL_MAX_US <= VALID_MAX_US,
              "expected VALID_MIN_US <= CHANNEL_MIN_US < CHANNEL_MAX_US <= VALID_MAX_US");
static_assert(safe_from(0), "SAFE_SLOTS_US: each slot between CHANNEL_MIN_US and CHANNEL_MAX_US");
static_assert(THROTTLE_CHANNEL >= 0 && THROTTLE_CHANNEL < CHANNELS, "THROTTLE_CHANNEL: a slot from 0 to CHANNELS - 1");
static_assert(SAFE_US[THROTTLE_CHANNEL] <= THROTTLE_CEILING_US, "THROTTLE_CEILING_US is below the idle throttle");
static_assert(SLEW_US > 0 && ENGAGE_FRAMES > 0 && ENGAGE_FRAMES < 256 && RANGE_FAULT_FRAMES > 0,
              "SLEW_US, ENGAGE_FRAMES (up to 255) and RANGE_FAULT_FRAMES: at least 1");
static_assert(HOST_TIMEOUT_MS >= 50 && HOST_TIMEOUT_MS <= 1000, "HOST_TIMEOUT_MS: 50 to 1000");
static_assert(ENGAGE_NEAR_US >= 0 && ENGAGE_IDLE_US >= 0 && ENGAGE_NEAR_US <= PILOT_MOVED_US && PILOT_MOVED_US <= 500,
              "expected 0 <= ENGAGE_NEAR_US <= PILOT_MOVED_US <= 500, and ENGAGE_IDLE_US from 0");
static_assert(ENGAGE_WITHOUT_PILOT == 0 || ENGAGE_WITHOUT_PILOT == 1, "ENGAGE_WITHOUT_PILOT: 0 or 1");
static_assert(PILOT_FRESH_MS >= 50 && PILOT_FRESH_MS <= 500, "PILOT_FRESH_MS: 50 to 500");
static_assert(BUZZER_PIN == 0 || (BUZZER_PIN >= 2 && BUZZER_PIN <= 53 && BUZZER_PIN != 11 && BUZZER_PIN != 19 &&
                                  BUZZER_PIN != 49),
              "BUZZER_PIN: 0, or a pin from 2 to 53 other than 11, 19 and 49");
static_assert(SILENT_AFTER_MS == 0 || SILENT_AFTER_MS >= HOST_TIMEOUT_MS, "SILENT_AFTER_MS: 0, or after HOST_TIMEOUT_MS");
static_assert(STATUS_HZ >= 1 && STATUS_HZ <= 50, "STATUS_HZ: 1 to 50");
static_assert(PILOT_SOURCE >= 0 && PILOT_SOURCE <= 2, "PILOT_SOURCE: 0, 1 or 2");
