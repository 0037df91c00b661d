// The portable part of the firmware as C functions. See host_api.h.
#include "host_api.h"

#include "config.h"
#include "link.h"
#include "ppm_in.h"
#include "ppm_out.h"
#include "safety.h"

namespace {

Safety* safety_of(void* pointer) { return static_cast<Safety*>(pointer); }
const Safety* safety_of(const void* pointer) { return static_cast<const Safety*>(pointer); }

// From and Into have the same interface, so each message's fields are listed once, below, for both directions.
struct From {
  const uint32_t* at;
  int left;
  template <class Field>
  void operator()(Field& field) {
    field = left > 0 ? static_cast<Field>(*at++) : Field(0);
    --left;
  }
};
struct Into {
  uint32_t* at;
  int count;
  template <class Field>
  void operator()(Field& field) {
    *at++ = field;
    ++count;
  }
};

template <class Values, class Message>
void channels(Values& values, Message& m) {
  for (uint8_t i = 0; i < m.n && i < MAX_CHANNELS; ++i) values(m.channels_us[i]);
}
void count_channels(From& values, Command& m) { m.n = static_cast<uint8_t>(values.left); }
void count_channels(Into&, Command&) {}  // the decoder has counted

template <class Values>
void fields(Values& values, Command& m) {
  values(m.sequence), values(m.flags), count_channels(values, m), channels(values, m);
}
template <class Values>
void fields(Values& values, Sync& m) {
  values(m.token);
}
template <class Values>
void fields(Values& values, Status& m) {
  values(m.version), values(m.device_time_us), values(m.state), values(m.fault), values(m.boot_count);
  values(m.reset_cause), values(m.last_sequence), values(m.accepted), values(m.bad_frames), values(m.bad_sequence);
  values(m.out_of_range), values(m.ppm_frames), values(m.flags), values(m.n), channels(values, m);
}
template <class Values>
void fields(Values& values, Pilot& m) {
  values(m.device_time_us), values(m.source), values(m.rejected), values(m.n), channels(values, m);
}
template <class Values>
void fields(Values& values, SyncReply& m) {
  values(m.token), values(m.received_us), values(m.sent_us);
}

template <class Message>
int encode_values(const uint32_t* values, int count, uint8_t* frame) {
  From from{values, count};
  Message message{};
  fields(from, message);
  return from.left == 0 ? encode(message, frame) : 0;
}

template <class Message>
bool decode_values(const uint8_t* payload, uint8_t size, int* count, uint32_t* values) {
  Message message{};
  if (!decode(payload, size, &message)) return false;
  Into into{values, 0};
  fields(into, message);
  *count = into.count;
  return true;
}

int copy_pilot(bool good, const Pilot& pilot, uint16_t* channels_us) {
  for (int i = 0; good && i < pilot.n; ++i) channels_us[i] = pilot.channels_us[i];
  return good ? pilot.n : 0;
}

}  // namespace

int config_channels(void) { return CHANNELS; }

void* safety_new(uint32_t now_us, int stalled) {
  Safety* safety = new Safety();
  safety->begin(now_us, stalled != 0);
  return safety;
}
void safety_free(void* safety) { delete safety_of(safety); }
int safety_frame(void* safety, uint32_t now_us, uint16_t sequence, int engage, const uint16_t* channels_us, int n) {
  const uint8_t count = n >= 0 && n <= MAX_CHANNELS ? static_cast<uint8_t>(n) : 0;
  return static_cast<int>(safety_of(safety)->frame(now_us, sequence, engage != 0, channels_us, count));
}
int safety_tick(void* safety, uint32_t now_us, const uint16_t* pilot_us, int n, uint16_t* slots_us) {
  Pilot pilot = Pilot();
  pilot.n = n >= 0 && n <= MAX_CHANNELS ? static_cast<uint8_t>(n) : 0;
  for (int i = 0; i < pilot.n; ++i) pilot.channels_us[i] = pilot_us[i];
  safety_of(safety)->tick(now_us, pilot.n > 0 ? &pilot : nullptr);
  for (int i = 0; i < CHANNELS; ++i) slots_us[i] = safety_of(safety)->slots_us()[i];
  return safety_of(safety)->silent();
}
int safety_state(const void* safety) { return static_cast<int>(safety_of(safety)->state()); }
int safety_fault(const void* safety) { return static_cast<int>(safety_of(safety)->fault()); }
int safety_has_pilot(const void* safety) { return safety_of(safety)->has_pilot(); }
int safety_pilot_took_over(const void* safety) { return safety_of(safety)->pilot_took_over(); }
int safety_size(void) { return static_cast<int>(sizeof(Safety)); }
void safety_flip(void* safety, int byte, int bit) {
  uint8_t* bytes = static_cast<uint8_t*>(safety);
  bytes[byte] = static_cast<uint8_t>(bytes[byte] ^ (1u << bit));
}
int safety_engage_frames(const void* safety) { return safety_of(safety)->engage_frames(); }
uint16_t safety_last_sequence(const void* safety) { return safety_of(safety)->last_sequence(); }
uint32_t safety_accepted(const void* safety) { return safety_of(safety)->accepted(); }
uint16_t safety_bad_sequence(const void* safety) { return safety_of(safety)->bad_sequence(); }
uint16_t safety_out_of_range(const void* safety) { return safety_of(safety)->out_of_range(); }

int link_encode(int type, const uint32_t* values, int count, uint8_t* frame) {
  switch (type) {
    case Command::TYPE: return encode_values<Command>(values, count, frame);
    case Sync::TYPE: return encode_values<Sync>(values, count, frame);
    case Status::TYPE: return encode_values<Status>(values, count, frame);
    case Pilot::TYPE: return encode_values<Pilot>(values, count, frame);
    case SyncReply::TYPE: return encode_values<SyncReply>(values, count, frame);
    default: return 0;
  }
}

int link_decode(const uint8_t* frame, int size, int* type, uint32_t* values) {
  Receiver receiver;
  uint8_t payload_size = 0;
  for (int i = 0; i < size && payload_size == 0; ++i) {
    payload_size = receiver.feed(frame[i]);
    if (payload_size > 0 && i != size - 1) return -1;
  }
  if (payload_size == 0) return -1;
  const uint8_t* payload = receiver.payload();
  int count = -1;
  *type = payload[0];
  const bool good = decode_values<Command>(payload, payload_size, &count, values) ||
                    decode_values<Sync>(payload, payload_size, &count, values) ||
                    decode_values<Status>(payload, payload_size, &count, values) ||
                    decode_values<Pilot>(payload, payload_size, &count, values) ||
                    decode_values<SyncReply>(payload, payload_size, &count, values);
  return good ? count : -1;
}

void* link_new(void) { return new Receiver(); }
void link_free(void* link) { delete static_cast<Receiver*>(link); }
int link_feed(void* link, void* safety, uint32_t now_us, const uint8_t* bytes, int size) {
  Receiver* receiver = static_cast<Receiver*>(link);
  int accepted = 0;
  for (int i = 0; i < size; ++i) {
    const uint8_t payload_size = receiver->feed(bytes[i]);
    Command command;
    Sync sync;
    if (payload_size == 0 || decode(receiver->payload(), payload_size, &sync)) continue;
    if (!decode(receiver->payload(), payload_size, &command)) {
      ++receiver->bad;
      continue;
    }
    const Verdict verdict =
        safety_of(safety)->frame(now_us, command.sequence, command.engage(), command.channels_us, command.n);
    accepted += verdict == Verdict::ACCEPTED;
    receiver->bad = static_cast<uint16_t>(receiver->bad + (verdict == Verdict::FORM));
  }
  return accepted;
}
int link_bad(const void* link) { return static_cast<const Receiver*>(link)->bad; }

void* ppm_out_new(void) { return new PpmOut(); }
void ppm_out_free(void* ppm) { delete static_cast<PpmOut*>(ppm); }
int ppm_out_next(void* ppm, const uint16_t* slots_us, int silent, uint16_t* after_ticks) {
  const PpmOut::Edge edge = static_cast<PpmOut*>(ppm)->next(slots_us, silent != 0);
  *after_ticks = edge.after_ticks;
  return edge.pulse;
}
int ppm_out_at_frame_start(const void* ppm) { return static_cast<const PpmOut*>(ppm)->at_frame_start(); }
uint32_t ppm_out_frames(const void* ppm) { return static_cast<const PpmOut*>(ppm)->frames(); }

void* pilot_ppm_new(void) { return new PilotPpm(); }
void pilot_ppm_free(void* pilot) { delete static_cast<PilotPpm*>(pilot); }
int pilot_ppm_edge(void* pilot, uint16_t capture_ticks, uint32_t time_us, uint16_t* channels_us) {
  PilotPpm* ppm = static_cast<PilotPpm*>(pilot);
  return copy_pilot(ppm->edge(capture_ticks, time_us), ppm->pilot, channels_us);
}
int pilot_ppm_rejected(const void* pilot) { return static_cast<const PilotPpm*>(pilot)->rejected; }
void* pilot_spektrum_new(void) { return new PilotSpektrum(); }
void pilot_spektrum_free(void* pilot) { delete static_cast<PilotSpektrum*>(pilot); }
int pilot_spektrum_byte(void* pilot, uint8_t value, uint32_t now_us, int wanted, uint16_t* channels_us) {
  PilotSpektrum* spektrum = static_cast<PilotSpektrum*>(pilot);
  return copy_pilot(spektrum->byte(value, now_us, static_cast<uint8_t>(wanted)), spektrum->pilot, channels_us);
}
int pilot_spektrum_rejected(const void* pilot) { return static_cast<const PilotSpektrum*>(pilot)->rejected; }
