// Tests of the portable firmware under AddressSanitizer and UndefinedBehaviorSanitizer; exit status 0 if all pass.
//
// A million corrupted frames, random bytes, noise on the pilot inputs and random traces of the safety machine, through
// host_api.h. A sanitizer ends the program at the first invalid memory access, a claim at the first failure.
#include <cstdio>
#include <cstdlib>
#include <random>
#include <vector>

#include "host_api.h"
#include "link.h"
#include "ppm_in.h"
#include "ppm_out.h"
#include "safety.h"

namespace {

constexpr int BROKEN_FRAMES = 1000000, FOUR_FLIPS = 200000, RANDOM_BUFFERS = 1000000, STRANGE_FRAMES = 300000;
constexpr int ROUND_TRIPS = 200000, PILOT_EDGES = 2000000;
constexpr int TRACES = 1000, STEPS_PER_TRACE = 2000, PPM_FRAMES = 100000;

std::mt19937 rng(20261121);  // fixed: every run is the same

uint32_t below(uint32_t n) { return std::uniform_int_distribution<uint32_t>(0, n - 1)(rng); }

void claim(bool holds, const char* what) {
  if (holds) return;
  std::printf("FAILED: %s\n", what);
  std::exit(1);
}

Command random_command() {
  Command command{};
  command.sequence = uint16_t(below(65536));
  command.flags = uint8_t(below(2));
  command.n = uint8_t(4 + below(5));
  for (uint8_t i = 0; i < command.n; ++i) command.channels_us[i] = uint16_t(VALID_MIN_US + below(1201));
  return command;
}

// A host, and the board's receiver and safety machine, connected by an unreliable line.
class BadLine {
 public:
  BadLine() : link_(link_new()), safety_(safety_new(0, 0)) {}
  ~BadLine() { link_free(link_), safety_free(safety_); }
  BadLine(const BadLine&) = delete;
  BadLine& operator=(const BadLine&) = delete;

  // The frame of the next command.
  std::vector<uint8_t> next_frame() {
    Command command = random_command();
    command.sequence = ++sequence_;
    command.n = CHANNELS;
    uint8_t frame[MAX_FRAME + 1];
    return std::vector<uint8_t>(frame, frame + encode(command, frame));
  }
  // Number of commands in these bytes that the board accepts.
  int send(const std::vector<uint8_t>& bytes) { return link_feed(link_, safety_, 0, bytes.data(), int(bytes.size())); }

 private:
  void *link_, *safety_;
  uint16_t sequence_ = 0;
};

// Flip `count` different bits of a frame, except in its final zero.
void flip(std::vector<uint8_t>* frame, uint32_t count) {
  std::vector<uint32_t> bits(8 * (frame->size() - 1));
  for (uint32_t i = 0; i < bits.size(); ++i) bits[i] = i;
  for (uint32_t i = 0; i < count; ++i) {
    std::swap(bits[i], bits[i + below(uint32_t(bits.size()) - i)]);
    uint8_t& byte = (*frame)[bits[i] / 8];
    byte = uint8_t(byte ^ 1u << bits[i] % 8);
  }
}

// Errors that a CRC of 16 bits always detects (except in rare cases that hit a length of COBS): up to three bits, two
// neighbouring bytes, a byte lost, doubled or inserted, the end cut off.
void spoil(std::vector<uint8_t>* frame) {
  const auto at = frame->begin() + below(uint32_t(frame->size()) - 2);
  const uint8_t before[] = {at[0], at[1]};
  switch (below(6)) {
    case 0: flip(frame, 1 + below(3)); break;
    case 1:
      while (at[0] == before[0] && at[1] == before[1]) at[0] = uint8_t(below(256)), at[1] = uint8_t(below(256));
      break;
    case 2: frame->erase(at); break;
    case 3: frame->insert(at, before[0]); break;
    case 4: frame->insert(at, uint8_t(1 + below(255))); break;
    default: frame->erase(at + 1, frame->end() - 1); break;
  }
}

void broken_frames_are_refused() {
  BadLine line;
  for (int i = 0; i < BROKEN_FRAMES; ++i) {
    std::vector<uint8_t> frame = line.next_frame();
    spoil(&frame);
    claim(line.send(frame) == 0, "a corrupted frame is refused");
    claim(line.send(line.next_frame()) == 1, "the valid frame after it is accepted");
  }
  std::printf("%d corrupted frames: 0 accepted; every valid frame after one accepted\n", BROKEN_FRAMES);
}

// Four flipped bits are the smallest error that a CRC-16 may miss: once in 2^15, as its polynomial detects all odd
// numbers of bits. Range and sequence reject most of the rest. So about 6 of 200,000 pass the CRC here (more than 16 with
// probability 1/4000), and fewer are accepted.
void four_flips_pass_as_rarely_as_theory_says() {
  Receiver receiver;
  BadLine line;
  int passed = 0, accepted = 0;
  for (int i = 0; i < FOUR_FLIPS; ++i) {
    std::vector<uint8_t> frame = line.next_frame();
    flip(&frame, 4);
    for (const uint8_t byte : frame) passed += receiver.feed(byte) > 0;
    accepted += line.send(frame);
  }
  std::printf("%d frames with four flipped bits: %d pass the CRC, %d accepted\n", FOUR_FLIPS, passed, accepted);
  claim(passed <= 16 && accepted <= passed, "four flipped bits pass as rarely as theory says");
}

// One byte in eight is a zero. A piece of more than 2 bytes has a matching CRC with probability 1/65536, and must then
// have the command's type, its length and a valid range: less than once in 10^9 pieces.
void random_bytes_are_refused() {
  BadLine line;
  std::vector<uint8_t> bytes;
  for (int i = 0; i < RANDOM_BUFFERS; ++i) {
    bytes.resize(below(101));
    for (uint8_t& byte : bytes) byte = below(8) == 0 ? 0 : uint8_t(below(256));
    claim(line.send(bytes) == 0, "random bytes are refused");
  }
  std::printf("%d buffers of random bytes: 0 accepted\n", RANDOM_BUFFERS);
}

// A frame of any payload by an independent COBS: pieces between zeros with their lengths.
std::vector<uint8_t> strange_frame(std::vector<uint8_t> payload) {
  const uint16_t crc = crc16(payload.data(), uint8_t(payload.size()));
  payload.push_back(uint8_t(crc)), payload.push_back(uint8_t(crc >> 8)), payload.push_back(0);
  std::vector<uint8_t> frame, piece;
  for (const uint8_t byte : payload) {
    if (byte != 0) {
      piece.push_back(byte);
      continue;
    }
    frame.push_back(uint8_t(piece.size() + 1));
    frame.insert(frame.end(), piece.begin(), piece.end());
    piece.clear();
  }
  frame.push_back(0);
  return frame;
}

// A valid CRC around any type, length and content: no invalid memory access, and a command still needs its length and
// range. Only every tenth has channels in the range of a command.
void strange_messages_are_refused() {
  constexpr uint8_t TYPES[] = {Command::TYPE, Sync::TYPE, Status::TYPE, Pilot::TYPE, SyncReply::TYPE, 0x00, 0x7F};
  for (int i = 0; i < STRANGE_FRAMES; ++i) {
    std::vector<uint8_t> payload(1 + below(70));
    for (uint8_t& byte : payload) byte = uint8_t(below(256));
    payload[0] = TYPES[below(sizeof TYPES)];
    bool valid = payload[0] == Command::TYPE && payload.size() == 4 + 2 * CHANNELS;
    for (size_t k = 4; k + 1 < payload.size(); k += 2) {
      if (i % 10 == 0) payload[k] = uint8_t(below(0x34)), payload[k + 1] = 0x04;  // 1024 to 1075 us
      const int us = payload[k] | payload[k + 1] << 8;
      valid = valid && us >= VALID_MIN_US && us <= VALID_MAX_US;
    }
    BadLine line;
    const std::vector<uint8_t> frame = strange_frame(payload);
    claim(line.send(frame) == valid, "a command is accepted only with the right length and range");
    int type = 0;
    uint32_t values[24];
    link_decode(frame.data(), int(frame.size()), &type, values);
  }
  std::printf("%d messages of any form with a valid CRC: only complete commands accepted\n", STRANGE_FRAMES);
}

void messages_come_back_as_they_were() {
  for (int i = 0; i < ROUND_TRIPS; ++i) {
    Receiver receiver;
    const Command sent = random_command();
    uint8_t frame[MAX_FRAME + 1], payload_size = 0;
    const uint8_t size = encode(sent, frame);
    for (uint8_t k = 0; k < size; ++k) {
      claim((frame[k] == 0) == (k == size - 1), "the only zero is the last byte");
      payload_size = receiver.feed(frame[k]);
    }
    Command got{};
    claim(decode(receiver.payload(), payload_size, &got), "a valid frame is decoded");
    bool same = got.sequence == sent.sequence && got.flags == sent.flags && got.n == sent.n;
    for (uint8_t k = 0; k < sent.n; ++k) same = same && got.channels_us[k] == sent.channels_us[k];
    claim(same && receiver.bad == 0, "decoding a message inverts encoding");
  }
  std::printf("%d messages encoded and decoded: all unchanged\n", ROUND_TRIPS);
}

// For any input the output is safe unless ACTIVE, and in ACTIVE every slot keeps its limits and slew rate. Half of the
// hosts ask with the pilot's sticks and then command anything; the pilot moves a stick now and then.
void slots_stay_within_limits() {
  int flown = 0;
  for (int trace = 0; trace < TRACES; ++trace) {
    Safety safety;
    uint32_t now_us = below(2) ? uint32_t(rng()) : 0u - below(3000000);  // half of them wrap
    uint16_t sequence = uint16_t(below(65536)), before[CHANNELS];
    bool engage = false;
    const bool asks_near = below(2) != 0;
    int entries = 0;
    Pilot pilot = Pilot(), measured;
    pilot.n = CHANNELS;
    for (uint8_t i = 0; i < CHANNELS; ++i) pilot.channels_us[i] = uint16_t(1000 + below(1001));
    safety.begin(now_us, below(4) == 0);
    for (int step = 0; step < STEPS_PER_TRACE; ++step) {
      now_us += below(50) == 0 ? 190000 + below(20000) : below(30000);
      if (below(12) == 0) engage = !engage;
      Command command = random_command();
      sequence = uint16_t(sequence + (below(20) == 0 ? below(65536) : 1));
      if (below(15) == 0) command.channels_us[below(4)] = uint16_t(below(65536));
      if (asks_near && safety.state() != State::ACTIVE) {
        for (uint8_t i = 0; i < CHANNELS; ++i) command.channels_us[i] = pilot.channels_us[i];
      }
      if (below(500) == 0) pilot.channels_us[below(CHANNELS)] = uint16_t(1000 + below(1001));
      const State state_before = safety.state();
      if (below(3) > 0) safety.frame(now_us, sequence, engage, command.channels_us, below(9) ? CHANNELS : command.n);
      if (state_before != State::ACTIVE && safety.state() == State::ACTIVE) {
        ++entries;
        for (uint8_t i = 0; safety.has_pilot() && i < CHANNELS; ++i) {
          const int away = command.channels_us[i] - measured.channels_us[i];
          claim(std::abs(away) <= ENGAGE_NEAR_US, "the host takes over near the pilot's sticks");
        }
      }
      for (uint8_t i = 0; i < CHANNELS; ++i) before[i] = safety.slots_us()[i];
      const bool is_measured = below(4) != 0;
      if (is_measured) measured = pilot;
      safety.tick(now_us, is_measured ? &pilot : nullptr);
      for (uint8_t i = 0; i < CHANNELS; ++i) {
        const int slot = safety.slots_us()[i], change = std::abs(slot - before[i]);
        claim(safety.state() == State::ACTIVE || slot == SAFE_US[i], "the output is safe unless ACTIVE");
        claim(slot >= CHANNEL_MIN_US && slot <= CHANNEL_MAX_US, "a slot stays within its limits");
        claim(i != THROTTLE_CHANNEL || slot <= THROTTLE_CEILING_US, "the throttle stays below its ceiling");
        claim(safety.state() != State::ACTIVE || change <= SLEW_US, "a slot changes by SLEW_US at most");
      }
    }
    flown += entries;
  }
  claim(flown > TRACES / 4, "the traces reach ACTIVE");
  std::printf("%d traces of %d steps: every slot safe or within its limits\n", TRACES, STEPS_PER_TRACE);
}

// Sum of the ticks: the 2 (CHANNELS + 1) edges of a frame take exactly FRAME_US.
void frames_are_as_long_as_they_should() {
  PpmOut ppm;
  uint16_t slots_us[CHANNELS];
  uint32_t since_start = 0;
  ppm.next(slots_us, false);  // the start: the first frame begins a frame later
  for (int frame = 0; frame < PPM_FRAMES; ++frame) {
    claim(ppm.at_frame_start() && since_start == (frame ? FRAME_US * TICKS_PER_US : 0u), "a frame lasts FRAME_US");
    for (uint16_t& slot_us : slots_us) slot_us = uint16_t(CHANNEL_MIN_US + below(CHANNEL_MAX_US - CHANNEL_MIN_US + 1));
    since_start = 0;
    for (int edge = 1; edge <= 2 * (CHANNELS + 1); ++edge) {
      const PpmOut::Edge next = ppm.next(slots_us, false);
      claim(next.pulse == (edge % 2 == 0), "beginnings and ends of pulses alternate");
      since_start += next.after_ticks;
      if (edge % 2 == 1) claim(next.after_ticks == GAP_PULSE_US * TICKS_PER_US, "each pulse lasts GAP_PULSE_US");
    }
  }
  claim(ppm.frames() == uint32_t(PPM_FRAMES), "each frame is counted");
  std::printf("%d PPM frames: pulses and frames exactly as long as configured\n", PPM_FRAMES);
}

// Noise on both pilot inputs: every reported frame has valid slots.
void noise_makes_no_impossible_pilot() {
  PilotPpm ppm;
  PilotSpektrum spektrum;
  int handed_out = 0;
  uint32_t now_us = 0;
  for (int i = 0; i < PILOT_EDGES; ++i) {
    now_us += below(6) == 0 ? 4000 + below(30000) : 300 + below(2500);
    const bool good = ppm.edge(uint16_t(now_us * TICKS_PER_US), now_us);
    handed_out += good;
    claim(!good || (ppm.pilot.n >= 4 && ppm.pilot.n <= MAX_CHANNELS), "a pilot frame has 4 to 8 slots");
    for (uint8_t k = 0; good && k < ppm.pilot.n; ++k) {
      claim(ppm.pilot.channels_us[k] >= 800 && ppm.pilot.channels_us[k] <= 2200, "a pilot's slot is 800 to 2200 us");
    }
    spektrum.byte(uint8_t(rng()), now_us, CHANNELS);
  }
  std::printf("%d edges of noise: %d random frames reported, none with an invalid slot\n", PILOT_EDGES, handed_out);
}

}  // namespace

int main() {
  broken_frames_are_refused();
  four_flips_pass_as_rarely_as_theory_says();
  random_bytes_are_refused();
  strange_messages_are_refused();
  messages_come_back_as_they_were();
  slots_stay_within_limits();
  frames_are_as_long_as_they_should();
  noise_makes_no_impossible_pilot();
  std::printf("host tests: all passed\n");
  return 0;
}
