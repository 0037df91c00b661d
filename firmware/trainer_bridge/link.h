// Serial link: messages <-> frames of bytes. Plain C++, no Arduino: a laptop compiles and tests the same file.
//
// A frame is COBS(payload + CRC-16) and one zero byte; numbers are little endian; the first payload byte is the type.
// COBS (Cheshire and Baker 1999) encodes any bytes without a zero, so a zero always ends a frame: after any
// disturbance the next frame is valid again. The CRC is CRC-16/CCITT-FALSE (polynomial 0x1021, start 0xFFFF).
#pragma once
#include <stdint.h>

constexpr uint8_t MAX_CHANNELS = 8;
constexpr uint8_t MAX_FRAME = 64;  // bytes before the zero; a longer frame is dropped up to its zero
constexpr uint8_t PROTOCOL_VERSION = 2;

// Host -> board: set values of the slots [us].
struct Command {
  static constexpr uint8_t TYPE = 0x01;
  uint16_t sequence;
  uint8_t flags;  // bit 0: engage
  uint8_t n;      // not transmitted: follows from the frame's length
  uint16_t channels_us[MAX_CHANNELS];
  bool engage() const { return flags & 1u; }
};

// Host -> board: request for the board's time. The token is returned.
struct Sync {
  static constexpr uint8_t TYPE = 0x02;
  uint32_t token;
};

// Board -> host: state and counters of the board. Counters wrap.
struct Status {
  static constexpr uint8_t TYPE = 0x11;
  static constexpr uint8_t SILENT = 1, ENGAGES_WITHOUT_PILOT = 2, HAS_PILOT = 4, PILOT_TOOK_OVER = 8;  // of flags
  uint8_t version;
  uint32_t device_time_us;
  uint8_t state, fault;            // safety.h
  uint8_t boot_count, reset_cause;  // reset_cause: register MCUSR, data sheet 12.5.1
  uint16_t last_sequence;
  uint32_t accepted;
  uint16_t bad_frames, bad_sequence, out_of_range;
  uint32_t ppm_frames;
  uint8_t flags;  // bits below
  uint8_t n;
  uint16_t channels_us[MAX_CHANNELS];
};

// Board -> host: the pilot's channels.
struct Pilot {
  static constexpr uint8_t TYPE = 0x12;
  uint32_t device_time_us;  // of the frame's last edge or byte
  uint8_t source;           // 0 PPM, 1 Spektrum serial
  uint16_t rejected;
  uint8_t n;
  uint16_t channels_us[MAX_CHANNELS];
};

// Board -> host: reply to Sync.
struct SyncReply {
  static constexpr uint8_t TYPE = 0x13;
  uint32_t token, received_us, sent_us;
};

// CRC-16/CCITT-FALSE of `size` bytes; the digits "123456789" give 0x29B1.
uint16_t crc16(const uint8_t* data, uint8_t size);

// Message -> frame with its zero byte. `frame` has room for MAX_FRAME + 1 bytes. Returns the number of bytes written.
uint8_t encode(const Command& message, uint8_t* frame);
uint8_t encode(const Sync& message, uint8_t* frame);
uint8_t encode(const Status& message, uint8_t* frame);
uint8_t encode(const Pilot& message, uint8_t* frame);
uint8_t encode(const SyncReply& message, uint8_t* frame);

// Payload (from Receiver) -> message. False if the type or the length differs.
bool decode(const uint8_t* payload, uint8_t size, Command* message);
bool decode(const uint8_t* payload, uint8_t size, Sync* message);
bool decode(const uint8_t* payload, uint8_t size, Status* message);
bool decode(const uint8_t* payload, uint8_t size, Pilot* message);
bool decode(const uint8_t* payload, uint8_t size, SyncReply* message);

// Byte stream -> payloads with a valid CRC.
class Receiver {
 public:
  // Process one byte. Returns the size of the payload that it completes, or 0.
  uint8_t feed(uint8_t byte);
  // The payload just completed: the type first, without CRC. Stays until the next feed().
  const uint8_t* payload() const { return buffer_; }

 private:
  uint8_t finish();

  uint8_t buffer_[MAX_FRAME];
  uint8_t size_ = 0;
  bool too_long_ = false;

 public:
  uint16_t bad = 0;  // frames with a wrong CRC or form; the decoder also counts wrong types and lengths here
};
