// PPM out: slots -> the next edge of the pin. See ppm_out.h.
#include "ppm_out.h"

PpmOut::Edge PpmOut::next(const uint16_t* slots_us, bool silent) {
  if (at_start_ && left_out_) {  // no pulse to end: check again a frame later
    left_out_ = silent;
    return {FRAME_US * TICKS_PER_US, !silent};
  }
  if (at_start_) {
    at_start_ = false;
    return {GAP_PULSE_US * TICKS_PER_US, false};
  }
  at_start_ = true;
  if (slot_ < CHANNELS) {
    const uint16_t slot_us = slots_us[slot_++];
    used_us_ = uint16_t(used_us_ + slot_us);
    return {uint16_t((slot_us - GAP_PULSE_US) * TICKS_PER_US), true};
  }
  const uint16_t pause_us = uint16_t(FRAME_US - used_us_);
  slot_ = 0;
  used_us_ = 0;
  ++frames_;
  left_out_ = silent;
  return {uint16_t((pause_us - GAP_PULSE_US) * TICKS_PER_US), !silent};
}
