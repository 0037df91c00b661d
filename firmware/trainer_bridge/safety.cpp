// Safety state machine: commands, the pilot's sticks and time in, safe slots out. See safety.h.
//
// Times are unsigned 32 bit and wrap after 71 minutes; a difference of two is valid for shorter intervals. tick()
// therefore clears expired times long before.
#include "safety.h"

namespace {

constexpr uint32_t SECOND_US = 1000000;
constexpr uint32_t HOST_TIMEOUT_US = 1000UL * HOST_TIMEOUT_MS;
constexpr uint32_t ENGAGE_WINDOW_US = 1000UL * ENGAGE_WINDOW_MS;
constexpr uint32_t PILOT_FRESH_US = 1000UL * PILOT_FRESH_MS;
constexpr uint32_t SILENT_AFTER_US = SILENT_AFTER_MS != 0 ? 1000UL * SILENT_AFTER_MS : UINT32_MAX;

constexpr uint8_t SEALED = 0xA5;  // the exclusive or of a sealed object's bytes; zeroed memory is not sealed

uint16_t distance(uint16_t a, uint16_t b) { return a > b ? uint16_t(a - b) : uint16_t(b - a); }

bool in_range(const uint16_t* channels_us) {
  for (uint8_t i = 0; i < CHANNELS; ++i) {
    if (channels_us[i] < VALID_MIN_US || channels_us[i] > VALID_MAX_US) return false;
  }
  return true;
}

// The output of a channel for the host's `wanted_us`.
uint16_t limited(uint8_t channel, uint16_t wanted_us) {
  const uint16_t top_us = channel == THROTTLE_CHANNEL && THROTTLE_CEILING_US < CHANNEL_MAX_US ? THROTTLE_CEILING_US
                                                                                              : CHANNEL_MAX_US;
  return wanted_us < CHANNEL_MIN_US ? CHANNEL_MIN_US : wanted_us > top_us ? top_us : wanted_us;
}

}  // namespace

void Safety::begin(uint32_t now_us, bool stalled) {
  restart(now_us, stalled ? Fault::STALL : Fault::NONE);
  seal();
}

void Safety::restart(uint32_t now_us, Fault fault) {
  *this = Safety();  // all zero
  state_ = fault != Fault::NONE ? State::FAULT : State::BOOT;
  fault_ = fault;
  last_engage_ = true;  // so the first command is no edge
  held_ = fault != Fault::NONE;
  held_since_us_ = now_us;
  for (uint8_t i = 0; i < CHANNELS; ++i) slots_us_[i] = safe_us(i);
}

uint8_t Safety::exclusive_or() const {
  static_assert(sizeof *this < 256, "the index is one byte");
  const uint8_t* bytes = reinterpret_cast<const uint8_t*>(this);
  uint8_t all = 0, left = sizeof *this;
  for (; left >= 8; left = uint8_t(left - 8), bytes += 8) {  // eight at a time: 20 us on the board, not 60
    all = uint8_t(all ^ bytes[0] ^ bytes[1] ^ bytes[2] ^ bytes[3] ^ bytes[4] ^ bytes[5] ^ bytes[6] ^ bytes[7]);
  }
  while (left > 0) all = uint8_t(all ^ bytes[--left]);
  return all;
}

void Safety::check_seal(uint32_t now_us) {
  if (exclusive_or() != SEALED) restart(now_us, Fault::MEMORY);
}

void Safety::seal() {
  seal_ = 0;
  seal_ = uint8_t(exclusive_or() ^ SEALED);
}

Verdict Safety::frame(uint32_t now_us, uint16_t sequence, bool engage, const uint16_t* channels_us, uint8_t n) {
  check_seal(now_us);
  const Verdict verdict = take(now_us, sequence, engage, channels_us, n);
  seal();
  return verdict;
}

Verdict Safety::take(uint32_t now_us, uint16_t sequence, bool engage, const uint16_t* channels_us, uint8_t n) {
  if (n != CHANNELS) return Verdict::FORM;
  if (!in_range(channels_us)) {
    violation(now_us);
    return Verdict::RANGE;
  }
  const uint16_t step = uint16_t(sequence - last_sequence_);
  if (contact_ && (step == 0 || step > 32767)) {
    ++bad_sequence_;
    return Verdict::SEQUENCE;
  }
  for (uint8_t i = 0; i < CHANNELS; ++i) target_us_[i] = channels_us[i];
  if (engage) this->engage(now_us, !last_engage_);
  else disengage(now_us);
  contact_ = true;
  silent_ = false;
  last_engage_ = engage;
  last_sequence_ = sequence;
  last_valid_us_ = now_us;
  ++accepted_;
  return Verdict::ACCEPTED;
}

void Safety::violation(uint32_t now_us) {
  ++out_of_range_;
  if (violations_ == 0 || now_us - first_violation_us_ >= SECOND_US) {
    first_violation_us_ = now_us;
    violations_ = 0;
  }
  if (++violations_ >= RANGE_FAULT_FRAMES) {
    violations_ = RANGE_FAULT_FRAMES;  // the counter must not wrap
    state_ = State::FAULT;
    fault_ = Fault::RANGE;
    engage_frames_ = 0;
  }
  if (state_ == State::FAULT) {
    held_ = true;
    held_since_us_ = now_us;
  }
}

void Safety::engage(uint32_t now_us, bool edge) {
  if (state_ != State::SAFE) return;
  const bool late = now_us - last_valid_us_ >= HOST_TIMEOUT_US || now_us - edge_us_ >= ENGAGE_WINDOW_US;
  if (edge) {
    edge_us_ = now_us;
    engage_frames_ = 1;
  } else if (engage_frames_ > 0) {
    engage_frames_ = late ? 0 : uint8_t(engage_frames_ + 1);
  }
  if (!matches()) engage_frames_ = 0;
  if (engage_frames_ >= ENGAGE_FRAMES) {
    engage_frames_ = 0;
    state_ = State::ACTIVE;
    has_reference_ = has_pilot_;
    for (uint8_t i = 0; i < CHANNELS; ++i) reference_us_[i] = pilot_us_[i];
  }
}

bool Safety::matches() const {
  if (ENGAGE_WITHOUT_PILOT && !has_pilot_) return true;
  for (uint8_t i = 0; i < CHANNELS; ++i) {
    const uint16_t now_us = has_pilot_ ? pilot_us_[i] : safe_us(i);
    const uint16_t most_us = !has_pilot_ && i == THROTTLE_CHANNEL ? ENGAGE_IDLE_US : ENGAGE_NEAR_US;
    if (distance(target_us_[i], now_us) > most_us) return false;
  }
  return true;
}

void Safety::disengage(uint32_t now_us) {
  engage_frames_ = 0;
  pilot_took_over_ = false;
  if (state_ == State::BOOT) return;
  if (state_ == State::FAULT && held_ && now_us - held_since_us_ < SECOND_US) return;
  state_ = State::SAFE;
  fault_ = Fault::NONE;
}

void Safety::tick(uint32_t now_us, const Pilot* pilot) {
  check_seal(now_us);
  if (state_ == State::BOOT) state_ = State::SAFE;
  if (pilot && pilot->n >= CHANNELS) see_pilot(now_us, *pilot);
  forget_old(now_us);
  move_slots();
  seal();
}

void Safety::see_pilot(uint32_t now_us, const Pilot& pilot) {
  has_pilot_ = true;
  pilot_at_us_ = now_us;
  bool moved = false;
  for (uint8_t i = 0; i < CHANNELS; ++i) {
    pilot_us_[i] = pilot.channels_us[i];
    if (!has_reference_) reference_us_[i] = pilot_us_[i];
    if (distance(pilot_us_[i], reference_us_[i]) > PILOT_MOVED_US) moved = true;
  }
  has_reference_ = true;
  if (state_ == State::ACTIVE && moved) {
    state_ = State::SAFE;
    pilot_took_over_ = true;
  }
}

void Safety::forget_old(uint32_t now_us) {
  const uint32_t silence_us = now_us - last_valid_us_;
  if (silence_us >= HOST_TIMEOUT_US) {
    engage_frames_ = 0;
    if (state_ == State::ACTIVE) state_ = State::LOST;
  }
  const bool may_be_silent = SILENT_AFTER_MS != 0 && contact_ && (state_ == State::SAFE || state_ == State::LOST);
  if (may_be_silent && silence_us >= SILENT_AFTER_US) silent_ = true;
  if (now_us - pilot_at_us_ >= PILOT_FRESH_US) has_pilot_ = false;
  if (now_us - first_violation_us_ >= SECOND_US) violations_ = 0;
  if (now_us - held_since_us_ >= SECOND_US) held_ = false;
}

void Safety::move_slots() {
  for (uint8_t i = 0; i < CHANNELS; ++i) {
    if (state_ != State::ACTIVE) {
      slots_us_[i] = safe_us(i);  // without a slew limit
      continue;
    }
    const int16_t way_us = int16_t(limited(i, target_us_[i]) - slots_us_[i]);
    const int16_t step_us = way_us > SLEW_US ? SLEW_US : way_us < -SLEW_US ? -SLEW_US : way_us;
    slots_us_[i] = uint16_t(slots_us_[i] + step_us);
  }
}
