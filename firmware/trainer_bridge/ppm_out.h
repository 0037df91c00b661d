// PPM out: slots -> the next edge of the pin. Plain C++, no Arduino: called by the interrupt.
//
//   idle  ____     ______     ______     ____ ... ______     ______________________     ___
//             |___|      |___|      |___|               |___|                      |___|
//   pulse      gap        gap        gap                 gap  last                  next frame
//             |<- slot 0 ->|<- slot 1 ->|               |<---- sync pause ---------->|
//             |<------------------------- FRAME_US -------------------------------->|
//
// A slot's value is the time from one pulse's start to the next one's (drawn for POLARITY 1: idle is high).
#pragma once
#include <stdint.h>

#include "config.h"

constexpr uint16_t TICKS_PER_US = 2;  // the timer counts at 16 MHz / 8

class PpmOut {
 public:
  struct Edge {
    uint16_t after_ticks;  // since the previous edge, which the timer has just made
    bool pulse;            // to the pulse's level; false: to idle
  };

  // The edge just made, or omitted in silence, begins a frame: its slots are computed now.
  bool at_frame_start() const { return at_start_ && slot_ == 0; }

  // The edge after the one just made. `slots_us`: CHANNELS slots, constant within a frame. `silent`: this frame is
  // completed, but no further one begins.
  Edge next(const uint16_t* slots_us, bool silent);

  // Number of complete frames. Wraps.
  uint32_t frames() const { return frames_; }

 private:
  bool at_start_ = true;  // the edge just made is the start of pulse slot_, otherwise its end
  bool left_out_ = true;  // ... but without a pulse: silence, or the start
  uint8_t slot_ = 0;
  uint16_t used_us_ = 0;  // from the frame's start to the start of pulse slot_
  uint32_t frames_ = 0;
};
