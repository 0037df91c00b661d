// Safety state machine: commands and time in, safe slots out. Plain C++, no Arduino: time is passed in.
//
//            first tick                 edge of engage and 5 commands in 500 ms
//     BOOT -------------> SAFE ---------------------------------------------------> ACTIVE
//                          ^  ^------------ a command without engage ----------------| |
//                          |                                                          | 200 ms without a command
//                          |------------ a command without engage ----- LOST <--------|
//                          |
//                          |-- a command without engage, 1 s later ---- FAULT <--- from any state: 5 commands out of
//                                                                                  range in 1 s, or loop() had hung
//
// "Command" means a VALID one: as many slots as configured, each within VALID_MIN_US..VALID_MAX_US, and a sequence
// number that advances by 1..32767 (modulo 65536). The host controls the slots in ACTIVE only; every other state
// outputs the safe slots of config.h. The radio's trainer switch overrides all of this.
//
// Where the rules leave a choice:
// - A command is checked for its form, then its range, then its sequence number; the first failure counts.
// - Limits are inclusive: a gap of exactly 200 ms is a loss, a fifth frame exactly 500 ms after the edge is too late.
//   An edge is valid after any gap.
// - An edge is detected in SAFE only; the command before it may have arrived in any state.
// - In FAULT any command out of range restarts the second, for every kind of fault. A command with engage still
//   counts as the last one before an edge.
// - Silence ends with a valid command, in any state.
#pragma once
#include <stdint.h>

#include "config.h"

enum class State : uint8_t { BOOT, SAFE, ACTIVE, LOST, FAULT };
enum class Fault : uint8_t { NONE, RANGE, STALL, CONFIG };  // CONFIG never occurs: such a config.h does not compile
enum class Verdict : uint8_t { ACCEPTED, SEQUENCE, RANGE, FORM };

class Safety {
 public:
  // Initialise. `stalled`: the reset was caused by a hung loop().
  void begin(uint32_t now_us, bool stalled);

  // Process a COMMAND with a valid CRC. `channels_us` holds n slots.
  Verdict frame(uint32_t now_us, uint16_t sequence, bool engage, const uint16_t* channels_us, uint8_t n);

  // Once per PPM frame, from the interrupt: computes the slots of this frame. Takes under 50 us on the board.
  void tick(uint32_t now_us);

  // Slots of the last tick [us]: CHANNELS of them.
  const uint16_t* slots_us() const { return slots_us_; }
  // No pulses at all (SILENT_AFTER_MS).
  bool silent() const { return silent_; }

  State state() const { return state_; }
  Fault fault() const { return fault_; }
  uint8_t engage_frames() const { return engage_frames_; }  // commands since the edge, the edge included; 0: no edge
  uint16_t last_sequence() const { return last_sequence_; }
  uint32_t accepted() const { return accepted_; }
  uint16_t bad_sequence() const { return bad_sequence_; }
  uint16_t out_of_range() const { return out_of_range_; }

 private:
  void violation(uint32_t now_us);
  void engage(uint32_t now_us, bool edge);
  void disengage(uint32_t now_us);
  void forget_old(uint32_t now_us);
  void move_slots();

  State state_;
  Fault fault_;
  bool contact_;      // a valid command has arrived since boot
  bool last_engage_;  // the flag of the last valid command
  bool silent_;
  bool held_;  // in FAULT: within the second in which nothing ends it
  uint8_t engage_frames_, violations_;
  uint16_t last_sequence_, bad_sequence_, out_of_range_;
  uint32_t accepted_;
  uint32_t last_valid_us_, edge_us_, first_violation_us_, held_since_us_;
  uint16_t target_us_[CHANNELS], slots_us_[CHANNELS];
};
