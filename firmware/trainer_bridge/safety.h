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
// number that advances by 1..32767 (modulo 65536). Only in ACTIVE does the host move a slot; in every other state the
// safe slots of config.h go out. The radio's own trainer switch stays above all of this.
//
// Where the rules leave a choice:
// - A command is looked at for its form, then its range, then its sequence number; the first that fails counts.
// - Limits belong to "too late": a gap of exactly 200 ms is a loss, a fifth frame exactly 500 ms after the edge is
//   too late. An edge is one whatever the gap before it.
// - The edge is looked for in SAFE only; but the command before it may have come in any state.
// - In FAULT any command out of range starts the second anew, whatever the fault was. A command with engage still
//   counts as the last one before an edge.
// - Silence ends with a valid command, in whatever state it comes.
#pragma once
#include <stdint.h>

#include "config.h"

enum class State : uint8_t { BOOT, SAFE, ACTIVE, LOST, FAULT };
enum class Fault : uint8_t { NONE, RANGE, STALL, CONFIG };  // CONFIG never comes: such a config.h does not compile
enum class Verdict : uint8_t { ACCEPTED, SEQUENCE, RANGE, FORM };

class Safety {
 public:
  // Start anew. `stalled`: the reset came because loop() had hung.
  void begin(uint32_t now_us, bool stalled);

  // A COMMAND with a right CRC has arrived. `channels_us` holds n slots.
  Verdict frame(uint32_t now_us, uint16_t sequence, bool engage, const uint16_t* channels_us, uint8_t n);

  // Once per PPM frame, from the interrupt: works out the slots that go out now. Takes under 50 us on the board.
  void tick(uint32_t now_us);

  // What the last tick worked out [us]: CHANNELS slots.
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
  bool contact_;      // a valid command has come since boot
  bool last_engage_;  // the flag of the last valid command
  bool silent_;
  bool held_;  // in FAULT: the second in which nothing ends it is not over
  uint8_t engage_frames_, violations_;
  uint16_t last_sequence_, bad_sequence_, out_of_range_;
  uint32_t accepted_;
  uint32_t last_valid_us_, edge_us_, first_violation_us_, held_since_us_;
  uint16_t target_us_[CHANNELS], slots_us_[CHANNELS];
};
