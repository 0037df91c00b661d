// Pilot input: edges of the radio's PPM, or bytes of a Spektrum remote receiver -> the pilot's channels.
// Plain C++, no Arduino: times are passed in.
#pragma once
#include <stdint.h>

#include "link.h"

// Edges of one direction -> frames. A frame is 4 to 8 slots of 800..2200 us between two pauses. A missing pulse makes
// a slot too long or a frame too short, an extra one a slot too short or a frame too long. The number of slots is
// therefore learnt once, from three equal frames; after that a frame with another number is rejected.
class PilotPpm {
 public:
  // Process an edge: the capture register and the same time on the 32 bit clock. True if it completed a valid frame,
  // which is in `pilot` until the next edge.
  bool edge(uint16_t capture_ticks, uint32_t time_us);

  Pilot pilot = Pilot();
  uint16_t rejected = 0;

 private:
  bool end_of_frame();
  bool expected(uint8_t n);

  uint16_t last_ticks_ = 0;
  uint32_t last_us_ = 0;
  uint16_t slots_us_[MAX_CHANNELS];
  uint8_t n_ = 0;
  bool whole_ = false;  // the frame's start was received and all slots so far are valid
  bool inside_ = false;
  uint8_t learnt_n_ = 0, like_n_ = 0, like_frames_ = 0;
};

// Bytes at 115200 baud -> channels. 16 bytes every 11 or 22 ms: two bytes of fades or system, then seven words, high
// byte first, each with a channel's number and position. There is no checksum, so the form is checked strictly.
class PilotSpektrum {
 public:
  // Process a byte. True if it completed a valid frame and `wanted` channels are known, which are then in `pilot`.
  bool byte(uint8_t value, uint32_t now_us, uint8_t wanted);

  Pilot pilot = Pilot();
  uint16_t rejected = 0;

 private:
  bool finish(uint32_t now_us, uint8_t wanted);

  uint8_t bytes_[16];
  uint8_t size_ = 0;
  uint8_t seen_ = 0;  // one bit per channel
  uint32_t last_us_ = 0;
};
