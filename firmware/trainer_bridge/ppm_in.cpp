// Pilot input: edges or bytes -> the pilot's channels. See ppm_in.h.
#include "ppm_in.h"

#include "config.h"

namespace {

constexpr uint16_t SLOT_MIN_US = 800, SLOT_MAX_US = 2200;  // the limits of radios
// Two slots merged by a missing pulse are shorter; the pause of eight long slots in 22.5 ms is longer.
constexpr uint16_t PAUSE_MIN_US = 4500;
constexpr uint32_t LOST_AFTER_US = 30000;  // the 16 bit timer wraps at 32.7 ms
constexpr uint8_t LEARN_FRAMES = 3;

constexpr uint32_t SPEKTRUM_PAUSE_US = 5000;  // a frame takes 1.4 ms, and the next comes 11 ms after it
constexpr uint32_t SPEKTRUM_STALE_US = 100000;
constexpr uint8_t SPEKTRUM_CHANNELS = 12;
constexpr uint8_t POSITION_BITS = SPEKTRUM_2048 ? 11 : 10;

// Positions span 1194 us from 903 us on (Spektrum, Remote Receiver Interfacing).
uint16_t spektrum_us(uint16_t position) { return uint16_t(903 + ((position * 1194UL) >> POSITION_BITS)); }

}  // namespace

bool PilotPpm::edge(uint16_t capture_ticks, uint32_t time_us) {
  const uint16_t interval_us = uint16_t((uint16_t(capture_ticks - last_ticks_) + 1u) / 2);
  const bool lost = time_us - last_us_ > LOST_AFTER_US;
  const bool pause = !lost && interval_us >= PAUSE_MIN_US;
  const bool good = pause && end_of_frame();
  last_ticks_ = capture_ticks;
  last_us_ = time_us;
  if (pause || lost) {
    n_ = 0;
    whole_ = true;
  } else if (whole_ && n_ < MAX_CHANNELS && interval_us >= SLOT_MIN_US && interval_us <= SLOT_MAX_US) {
    slots_us_[n_++] = interval_us;
  } else if (whole_) {
    whole_ = false;
    ++rejected;
  }
  return good;
}

bool PilotPpm::end_of_frame() {
  if (!whole_) return false;  // counted at its invalid slot
  if (!expected(n_)) {
    if (learnt_n_ != 0) ++rejected;
    return false;
  }
  pilot.device_time_us = last_us_;
  pilot.source = 0;
  pilot.rejected = rejected;
  pilot.n = n_;
  for (uint8_t i = 0; i < n_; ++i) pilot.channels_us[i] = slots_us_[i];
  return true;
}

bool PilotPpm::expected(uint8_t n) {
  if (n < 4) return false;
  like_frames_ = n != like_n_ ? 1 : like_frames_ < LEARN_FRAMES ? uint8_t(like_frames_ + 1) : LEARN_FRAMES;
  like_n_ = n;
  if (like_frames_ == LEARN_FRAMES) learnt_n_ = n;
  return n == learnt_n_;
}

bool PilotSpektrum::byte(uint8_t value, uint32_t now_us, uint8_t wanted) {
  const uint32_t pause_us = now_us - last_us_;
  last_us_ = now_us;
  if (pause_us >= SPEKTRUM_STALE_US) seen_ = 0;
  if (pause_us >= SPEKTRUM_PAUSE_US) {
    if (size_ % sizeof bytes_ != 0) ++rejected;  // the previous frame was incomplete
    size_ = 0;
  }
  if (size_ >= sizeof bytes_) return false;  // too long, or joined in the middle: wait for a pause
  bytes_[size_++] = value;
  return size_ == sizeof bytes_ && finish(now_us, wanted);
}

bool PilotSpektrum::finish(uint32_t now_us, uint8_t wanted) {
  uint16_t found = 0, channels_us[MAX_CHANNELS];
  for (uint8_t i = 2; i < sizeof bytes_; i = uint8_t(i + 2)) {
    const uint16_t word = uint16_t(uint16_t(bytes_[i]) << 8 | bytes_[i + 1]);
    if (word == 0xFFFF) continue;  // unused
    const uint8_t channel = (word >> POSITION_BITS) & 0xF;
    if (channel >= SPEKTRUM_CHANNELS || (found & (1u << channel))) {
      ++rejected;
      return false;
    }
    found = uint16_t(found | 1u << channel);
    if (channel < MAX_CHANNELS) channels_us[channel] = spektrum_us(word & ((1u << POSITION_BITS) - 1));
  }
  for (uint8_t i = 0; i < MAX_CHANNELS; ++i) {
    if (found & (1u << i)) pilot.channels_us[i] = channels_us[i];
  }
  seen_ = uint8_t(seen_ | found);
  pilot.device_time_us = now_us;
  pilot.source = 1;
  pilot.rejected = rejected;
  pilot.n = wanted;
  const uint8_t all = uint8_t((1u << wanted) - 1);
  return (seen_ & all) == all;
}
