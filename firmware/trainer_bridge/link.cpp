// Serial link: messages <-> frames of bytes. See link.h.
#include "link.h"

namespace {

// Writer and Reader have the same interface, so each message's layout is written once, below, for both directions.
class Writer {
 public:
  explicit Writer(uint8_t* at) : at_(at) {}
  void u8(uint8_t value) { *at_++ = value; }
  void u16(uint16_t value) { u8(uint8_t(value)), u8(uint8_t(value >> 8)); }
  void u32(uint32_t value) { u16(uint16_t(value)), u16(uint16_t(value >> 16)); }
  void counted(uint8_t n, const uint16_t* values) { u8(n), rest(n, values); }
  void rest(uint8_t n, const uint16_t* values) {
    for (uint8_t i = 0; i < n; ++i) u16(values[i]);
  }
  uint8_t* at() const { return at_; }

 private:
  uint8_t* at_;
};

class Reader {
 public:
  Reader(const uint8_t* at, uint8_t size) : at_(at), left_(size) {}
  void u8(uint8_t& value) {
    if (left_ == 0) good_ = false;
    else value = *at_++, --left_;
  }
  void u16(uint16_t& value) {
    uint8_t low = 0, high = 0;
    u8(low), u8(high);
    value = uint16_t(low | high << 8);
  }
  void u32(uint32_t& value) {
    uint16_t low = 0, high = 0;
    u16(low), u16(high);
    value = low | uint32_t(high) << 16;
  }
  void counted(uint8_t& n, uint16_t* values) {  // n, then n values
    u8(n);
    if (n != left_ / 2) good_ = false;
    rest(n, values);
  }
  void rest(uint8_t& n, uint16_t* values) {  // all remaining bytes as values
    n = left_ / 2;
    if (n < 4 || n > MAX_CHANNELS) good_ = false;
    for (uint8_t i = 0; good_ && i < n; ++i) u16(values[i]);
  }
  bool all_read() const { return good_ && left_ == 0; }

 private:
  const uint8_t* at_;
  uint8_t left_;
  bool good_ = true;
};

// Fields of each message, in order of transmission.
template <class Bytes>
void layout(Bytes& bytes, Command& m) {
  bytes.u16(m.sequence), bytes.u8(m.flags), bytes.rest(m.n, m.channels_us);
}
template <class Bytes>
void layout(Bytes& bytes, Sync& m) {
  bytes.u32(m.token);
}
template <class Bytes>
void layout(Bytes& bytes, Status& m) {
  bytes.u8(m.version), bytes.u32(m.device_time_us), bytes.u8(m.state), bytes.u8(m.fault);
  bytes.u8(m.boot_count), bytes.u8(m.reset_cause), bytes.u16(m.last_sequence), bytes.u32(m.accepted);
  bytes.u16(m.bad_frames), bytes.u16(m.bad_sequence), bytes.u16(m.out_of_range), bytes.u32(m.ppm_frames);
  bytes.u8(m.flags), bytes.counted(m.n, m.channels_us);
}
template <class Bytes>
void layout(Bytes& bytes, Pilot& m) {
  bytes.u32(m.device_time_us), bytes.u8(m.source), bytes.u16(m.rejected), bytes.counted(m.n, m.channels_us);
}
template <class Bytes>
void layout(Bytes& bytes, SyncReply& m) {
  bytes.u32(m.token), bytes.u32(m.received_us), bytes.u32(m.sent_us);
}

// Each zero is replaced by the distance to the next one; the first byte is the distance to the first zero.
// Valid for up to 254 bytes; these frames have fewer than 64.
uint8_t cobs_encode(const uint8_t* data, uint8_t size, uint8_t* frame) {
  uint8_t hole = 0, at = 1;
  for (uint8_t i = 0; i < size; ++i) {
    if (data[i] == 0) {
      frame[hole] = uint8_t(at - hole);
      hole = at++;
    } else {
      frame[at++] = data[i];
    }
  }
  frame[hole] = uint8_t(at - hole);
  frame[at++] = 0;
  return at;
}

// In place; the result is one byte shorter. Returns its size, or 0 if a distance points behind the end.
uint8_t cobs_decode(uint8_t* bytes, uint8_t size) {
  uint8_t hole = 0;
  while (hole < size) {
    const uint8_t distance = bytes[hole];
    if (distance == 0 || distance > size - hole) return 0;
    bytes[hole] = 0;
    hole = uint8_t(hole + distance);
  }
  for (uint8_t i = 1; i < size; ++i) bytes[i - 1] = bytes[i];
  return uint8_t(size - 1);
}

template <class Message>
uint8_t to_frame(Message message, uint8_t* frame) {
  uint8_t payload[MAX_FRAME];
  Writer writer(payload);
  writer.u8(Message::TYPE);
  layout(writer, message);
  writer.u16(crc16(payload, uint8_t(writer.at() - payload)));
  return cobs_encode(payload, uint8_t(writer.at() - payload), frame);
}

template <class Message>
bool from_payload(const uint8_t* payload, uint8_t size, Message* message) {
  if (size == 0 || payload[0] != Message::TYPE) return false;
  Reader reader(payload + 1, uint8_t(size - 1));
  layout(reader, *message);
  return reader.all_read();
}

}  // namespace

uint16_t crc16(const uint8_t* data, uint8_t size) {
  uint16_t crc = 0xFFFF;
  while (size-- > 0) {
    crc = uint16_t(crc ^ (uint16_t(*data++) << 8));
    for (uint8_t bit = 0; bit < 8; ++bit) crc = uint16_t(crc & 0x8000 ? crc << 1 ^ 0x1021 : crc << 1);
  }
  return crc;
}

uint8_t encode(const Command& message, uint8_t* frame) { return to_frame(message, frame); }
uint8_t encode(const Sync& message, uint8_t* frame) { return to_frame(message, frame); }
uint8_t encode(const Status& message, uint8_t* frame) { return to_frame(message, frame); }
uint8_t encode(const Pilot& message, uint8_t* frame) { return to_frame(message, frame); }
uint8_t encode(const SyncReply& message, uint8_t* frame) { return to_frame(message, frame); }

bool decode(const uint8_t* payload, uint8_t size, Command* message) { return from_payload(payload, size, message); }
bool decode(const uint8_t* payload, uint8_t size, Sync* message) { return from_payload(payload, size, message); }
bool decode(const uint8_t* payload, uint8_t size, Status* message) { return from_payload(payload, size, message); }
bool decode(const uint8_t* payload, uint8_t size, Pilot* message) { return from_payload(payload, size, message); }
bool decode(const uint8_t* payload, uint8_t size, SyncReply* message) { return from_payload(payload, size, message); }

uint8_t Receiver::feed(uint8_t byte) {
  if (byte == 0) return finish();
  if (size_ < MAX_FRAME) buffer_[size_++] = byte;
  else too_long_ = true;
  return 0;
}

uint8_t Receiver::finish() {
  const uint8_t received = size_;
  const bool too_long = too_long_;
  size_ = 0;
  too_long_ = false;
  if (received == 0) return 0;  // two zeros in a row: an empty frame is not an error
  const uint8_t size = too_long ? 0 : cobs_decode(buffer_, received);
  if (size > 2 && crc16(buffer_, uint8_t(size - 2)) == (buffer_[size - 2] | uint16_t(buffer_[size - 1]) << 8)) {
    return uint8_t(size - 2);
  }
  ++bad;
  return 0;
}
