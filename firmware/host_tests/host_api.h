/* The portable part of the firmware as C functions for Python's ctypes.
 *
 * Built by `make -C firmware host-lib` into build/libtrainer_bridge.so. Objects are made by *_new and ended by *_free.
 * All times are device microseconds, unsigned 32 bit, and wrap. */
#pragma once
#include <stdint.h>

#ifdef __cplusplus
extern "C" {
#endif

/* config.h as compiled: CHANNELS. */
int config_channels(void);

/* ---- safety.h ---- */
void* safety_new(uint32_t now_us, int stalled);
void safety_free(void* safety);
/* 0 accepted, 1 sequence does not advance, 2 out of range, 3 wrong number of channels. */
int safety_frame(void* safety, uint32_t now_us, uint16_t sequence, int engage, const uint16_t* channels_us, int n);
/* pilot_us: n slots of the pilot's frame measured since the last tick; n 0 for none. Writes CHANNELS slots [us];
 * returns 1 for no pulses. */
int safety_tick(void* safety, uint32_t now_us, const uint16_t* pilot_us, int n, uint16_t* slots_us);
int safety_state(const void* safety);         /* 0 BOOT 1 SAFE 2 ACTIVE 3 LOST 4 FAULT */
int safety_fault(const void* safety);         /* 0 none 1 range 2 stall 3 memory */
int safety_has_pilot(const void* safety);
int safety_pilot_took_over(const void* safety);
int safety_size(void);                        /* bytes of the object */
void safety_flip(void* safety, int byte, int bit); /* disturb its memory */
int safety_engage_frames(const void* safety); /* commands since the edge of engage, that one included; 0: no edge */
uint16_t safety_last_sequence(const void* safety);
uint32_t safety_accepted(const void* safety);
uint16_t safety_bad_sequence(const void* safety);
uint16_t safety_out_of_range(const void* safety);

/* ---- link.h: values are the message's fields in order of transmission, without the type; arrays follow last ----
 * COMMAND: sequence, flags, channels...   SYNC: token   SYNC_REPLY: token, received_us, sent_us
 * STATUS: version, device_time_us, state, fault, boot_count, reset_cause, last_sequence, accepted, bad_frames,
 *         bad_sequence, out_of_range, ppm_frames, flags, n, channels...
 * PILOT: device_time_us, source, rejected, n, channels... */
/* Message -> frame with its zero byte (room for 65 bytes); returns its size, 0 for an unknown type or wrong count. */
int link_encode(int type, const uint32_t* values, int count, uint8_t* frame);
/* Frame -> values (room for 24); returns how many, -1 if the frame is not one valid message. */
int link_decode(const uint8_t* frame, int size, int* type, uint32_t* values);

/* Bytes through the receiver into the safety machine, as the board's loop() does; both keep their state. */
void* link_new(void);
void link_free(void* link);
/* Returns how many COMMANDs were accepted. */
int link_feed(void* link, void* safety, uint32_t now_us, const uint8_t* bytes, int size);
int link_bad(const void* link);

/* ---- ppm_out.h ---- */
void* ppm_out_new(void);
void ppm_out_free(void* ppm);
/* The edge after the one just made: writes the ticks [0.5 us] between the two; returns 1 for a pulse, 0 for idle. */
int ppm_out_next(void* ppm, const uint16_t* slots_us, int silent, uint16_t* after_ticks);
int ppm_out_at_frame_start(const void* ppm);
uint32_t ppm_out_frames(const void* ppm);

/* ---- ppm_in.h: both write up to 8 channels [us] and return how many, 0 if no frame was completed ---- */
void* pilot_ppm_new(void);
void pilot_ppm_free(void* pilot);
int pilot_ppm_edge(void* pilot, uint16_t capture_ticks, uint32_t time_us, uint16_t* channels_us);
int pilot_ppm_rejected(const void* pilot);
void* pilot_spektrum_new(void);
void pilot_spektrum_free(void* pilot);
int pilot_spektrum_byte(void* pilot, uint8_t value, uint32_t now_us, int wanted, uint16_t* channels_us);
int pilot_spektrum_rejected(const void* pilot);

#ifdef __cplusplus
}
#endif
