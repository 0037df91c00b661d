// Safety state machine: commands, the pilot's sticks and time in, safe slots out. Plain C++, no Arduino: time is passed
// in.
//
//            first tick        edge of engage and 5 matching commands in 500 ms
//     BOOT -------------> SAFE -------------------------------------------------> ACTIVE
//                          ^  ^--- a command without engage, or the pilot moved a stick -| |
//                          |                                                             | 200 ms without a command
//                          |------------ a command without engage ----- LOST <-----------|
//                          |
//                          |-- a command without engage, 1 s later ---- FAULT <--- from any state: 5 commands out of
//                                                                       range in 1 s, a disturbed memory, or a
//                                                                       restart by the watchdog
//
// "Command" means a VALID one: as many slots as configured, each within VALID_MIN_US..VALID_MAX_US, and a sequence
// number that advances by 1..32767 (modulo 65536). The host controls the slots in ACTIVE only; every other state
// outputs the safe slots of config.h. The radio's trainer switch overrides all of this.
//
// A command MATCHES if taking over moves nothing: where the pilot's sticks are measured (a frame in the last
// PILOT_FRESH_MS), each of its slots is within ENGAGE_NEAR_US of the pilot's. Where they are not, its throttle is
// within ENGAGE_IDLE_US of idle and the others within ENGAGE_NEAR_US of neutral; ENGAGE_WITHOUT_PILOT 1 drops this.
// The pilot MOVED A STICK if a slot is more than PILOT_MOVED_US from where it was at the engagement (or in the first
// frame measured after it). No computer flies against the pilot.
//
// Where the rules leave a choice:
// - A command is checked for its form, then its range, then its sequence number; the first failure counts.
// - Limits are inclusive: a gap of exactly 200 ms is a loss, a fifth frame exactly 500 ms after the edge is too late.
//   An edge is valid after any gap. Distances in microseconds may reach their limit.
// - An edge is detected in SAFE only; the command before it may have arrived in any state. A command with engage that
//   does not match ends the count: it takes a new edge.
// - In FAULT any command out of range restarts the second, for every kind of fault. A command with engage still
//   counts as the last one before an edge.
// - Silence ends with a valid command, in any state.
// - A pilot's signal that stops does not end ACTIVE: the trainer switch still does. When it returns, the sticks are
//   compared with where they were.
//
// The object carries a seal, one byte that makes the exclusive or of all its bytes a constant. It is made after every
// call and checked before the next one, so that no flipped bit of memory can engage or move a slot for a second frame.
#pragma once
#include <stdint.h>

#include "config.h"
#include "link.h"

enum class State : uint8_t { BOOT, SAFE, ACTIVE, LOST, FAULT };
enum class Fault : uint8_t { NONE, RANGE, STALL, MEMORY };
enum class Verdict : uint8_t { ACCEPTED, SEQUENCE, RANGE, FORM };

class Safety {
 public:
  // Initialise. `stalled`: the reset was caused by a hung loop().
  void begin(uint32_t now_us, bool stalled);

  // Process a COMMAND with a valid CRC. `channels_us` holds n slots.
  Verdict frame(uint32_t now_us, uint16_t sequence, bool engage, const uint16_t* channels_us, uint8_t n);

  // Once per PPM frame, from the interrupt: computes the slots of this frame. `pilot`: the pilot's frame measured since
  // the last tick, null for none; one with fewer slots than CHANNELS counts as none.
  void tick(uint32_t now_us, const Pilot* pilot);

  // Slots of the last tick [us]: CHANNELS of them.
  const uint16_t* slots_us() const { return slots_us_; }
  // No pulses at all (SILENT_AFTER_MS).
  bool silent() const { return silent_; }
  // A pilot's frame was measured in the last PILOT_FRESH_MS.
  bool has_pilot() const { return has_pilot_; }
  // A stick of the pilot ended the engagement, and no command without engage has come since.
  bool pilot_took_over() const { return pilot_took_over_; }

  State state() const { return state_; }
  Fault fault() const { return fault_; }
  uint8_t engage_frames() const { return engage_frames_; }  // commands since the edge, the edge included; 0: no edge
  uint16_t last_sequence() const { return last_sequence_; }
  uint32_t accepted() const { return accepted_; }
  uint16_t bad_sequence() const { return bad_sequence_; }
  uint16_t out_of_range() const { return out_of_range_; }

 private:
  void restart(uint32_t now_us, Fault fault);
  uint8_t exclusive_or() const;
  void check_seal(uint32_t now_us);
  void seal();
  Verdict take(uint32_t now_us, uint16_t sequence, bool engage, const uint16_t* channels_us, uint8_t n);
  void violation(uint32_t now_us);
  void engage(uint32_t now_us, bool edge);
  void disengage(uint32_t now_us);
  bool matches() const;
  void see_pilot(uint32_t now_us, const Pilot& pilot);
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
  bool has_pilot_, pilot_took_over_;
  bool has_reference_;  // reference_us_: the pilot's sticks at the engagement
  uint32_t pilot_at_us_;
  uint16_t pilot_us_[CHANNELS], reference_us_[CHANNELS];
  uint8_t seal_;
};
