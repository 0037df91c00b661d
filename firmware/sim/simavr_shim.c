/* Simulated board: ELF file, bytes on serial lines, edges on a pin -> bytes and PPM edges, cycle by cycle.
 *
 * A thin layer over libsimavr 1.6 (Debian: libsimavr-dev), loaded from Python with ctypes
 * (falconwing_kit/tools/bridge/simulated_board.py). Time is counted in cycles of 16 MHz since power-on and runs only
 * inside sim_run; a sleeping chip jumps to its next event. Relevant differences of libsimavr from silicon:
 *  - its UART counts 11 bits a byte; corrected to the 10 bits of 8N1 (uart_pace);
 *  - its receiver holds 63 bytes, silicon two, and a third until the next one starts (data sheet 22.7.4); here the
 *    third is lost, and counted (on_line);
 *  - its output compare moves the pin at a match, but also where Timer1 wraps and where OCR1A is written, to the
 *    opposite of the next match. In normal mode silicon does not (data sheet 17.8), so its pin is ignored and derived
 *    from the matches and COM1A (on_match). Its changes at wraps are counted (on_oc_pin);
 *  - it has no FOC1A, the match by hand (on_force);
 *  - a write to PORTB shows on PB5 although the timer owns that pin; ignored then (on_port);
 *  - it stops where silicon goes on: asleep with interrupts off, or outside flash or memory. After a disturbed bit
 *    (sim_flip) the chip then stands still until its watchdog resets it;
 *  - it lacks the mode in which Arduino's core starts the timers, 8-bit phase-correct PWM, and wraps them at every tick;
 *    here they count to 255, without the way back (add_phase_correct_mode);
 *  - it does not compare a pin's direction with its level (on_direction);
 *  - during a reset its pins keep their level; on hardware the resistors define it;
 *  - there is no bootloader: the sketch starts immediately.
 */
#include <stdint.h>
#include <stdio.h>
#include <stdlib.h>
#include <string.h>

#include "avr_ioport.h"
#include "avr_timer.h"
#include "avr_uart.h"
#include "sim_avr.h"
#include "sim_elf.h"

enum { CLOCK_HZ = 16000000, UARTS = 2, RAM_START = 0x200 };
enum { SPL = 0x5D, SREG = 0x5F, WDTCSR = 0x60, WDE = 0x08, DDRB = 0x24, PORTB = 0x25, PB5 = 0x20, VECTOR_BYTES = 4 };
enum { TCCR1A = 0x80, TCCR1C = 0x82, FOC1A = 0x80, TIMER1_COMPA = 17, TIMER1_TICK = 8 };
enum { NINTHS = 9, BYTE_NINTHS = 12500 }; /* ten bits at 115200 baud are 12500 / 9 cycles of 16 MHz */
enum { LONGEST_RUN = 1000000, STANDSTILL = 160, JUMP_TO_ITSELF = 0xCFFF, RETURN_FROM_INTERRUPT = 0x9518 };
enum { LOOP, PULSES, PARTS };
enum { ARTEFACTS, OVERRUNS, WATCHDOG_RESETS, COUNTERS };

typedef struct { /* events at a cycle: bytes of a line or levels of a pin, oldest first */
    uint64_t *at;
    uint8_t *value;
    size_t first, last, room;
} queue;

typedef struct board board;

typedef struct { /* one serial line towards the chip */
    board *owner;
    avr_uart_t *uart;
    avr_irq_t *input;
    uint8_t waiting, is_waiting; /* the second byte that the receiver holds */
    uint64_t free_at; /* when the next byte may start, in ninths of a cycle */
    queue bytes;
} line;

struct board {
    avr_t *avr;
    avr_timer_t *timer1;
    avr_irq_t *pilot_pin;
    line lines[UARTS];
    queue sent, edges, pilot;
    uint64_t until;
    uint32_t counters[COUNTERS];
    uint32_t part_address[PARTS]; /* bytes in flash: loop(), 0 if the ELF does not contain it; Timer1's vector */
    uint16_t part_code[PARTS];    /* the first instruction there, while another one replaces it */
    int stopped[PARTS], is_flipped;
    int oc_level, pin_level; /* of the timer's output, and of the pin */
    void (*core_reset)(avr_t *);
};

static char last_error[200];

static void keep_error(avr_t *avr, const int level, const char *format, va_list arguments) {
    (void)avr;
    if (level == LOG_ERROR) vsnprintf(last_error, sizeof last_error, format, arguments);
}

static void push(queue *q, uint64_t at, uint8_t value) {
    if (q->last == q->room) {
        size_t waiting = q->last - q->first;
        if (waiting * 2 >= q->room) {
            q->room = q->room ? q->room * 2 : 1024;
            q->at = realloc(q->at, q->room * sizeof *q->at);
            q->value = realloc(q->value, q->room);
            if (!q->at || !q->value) abort();
        }
        memmove(q->at, q->at + q->first, waiting * sizeof *q->at);
        memmove(q->value, q->value + q->first, waiting);
        q->first = 0, q->last = waiting;
    }
    q->at[q->last] = at;
    q->value[q->last++] = value;
}

static int is_empty(const queue *q) { return q->first == q->last; }
static uint64_t next_at(const queue *q) { return q->at[q->first]; }
static uint8_t pop(queue *q) { return q->value[q->first++]; }

/* ---- serial lines ---- */

static void uart_pace(avr_uart_t *uart) { /* data sheet 22.3.1: a bit is 16 (UBRR + 1) cycles, 8 where U2X is set */
    avr_t *avr = uart->io.avr;
    uint32_t divider = avr_regbit_get(avr, uart->ubrrl) | avr_regbit_get(avr, uart->ubrrh) << 8;
    uart->cycles_per_byte = 10 * (divider + 1) * (avr_regbit_get(avr, uart->u2x) ? 8 : 16);
}

static void hand_over(line *l) { /* to libsimavr's receiver, one byte at a time and without its own delay */
    avr_cycle_count_t pace = l->uart->cycles_per_byte;
    if (!l->is_waiting || l->uart->input.read != l->uart->input.write) return;
    l->is_waiting = 0;
    l->uart->cycles_per_byte = 1;
    avr_raise_irq(l->input, l->waiting);
    l->uart->cycles_per_byte = pace;
}

static void on_room(avr_irq_t *irq, uint32_t value, void *parameter) { /* the program has read */
    (void)irq, (void)value;
    hand_over(parameter);
}

static avr_cycle_count_t on_line(avr_t *avr, avr_cycle_count_t when, void *parameter) { /* the end of a byte */
    line *l = parameter;
    (void)avr, (void)when;
    uint8_t byte = pop(&l->bytes);
    if (l->is_waiting)
        l->owner->counters[OVERRUNS]++;
    else
        l->waiting = byte, l->is_waiting = 1, hand_over(l);
    return is_empty(&l->bytes) ? 0 : next_at(&l->bytes);
}

static void on_sent(avr_irq_t *irq, uint32_t value, void *parameter) {
    board *b = parameter;
    (void)irq;
    uart_pace(b->lines[0].uart);
    push(&b->sent, b->avr->cycle + b->lines[0].uart->cycles_per_byte, value);
}

/* ---- pins ---- */

static void set_pin(board *b, int level) {
    b->oc_level = level;
    if (!(b->avr->data[DDRB] & PB5)) return; /* an input keeps its level: the resistors define it */
    if (level != b->pin_level) push(&b->edges, b->avr->cycle, level);
    b->pin_level = level;
}

static void on_direction(avr_irq_t *irq, uint32_t directions, void *parameter) {
    board *b = parameter;
    (void)irq, (void)directions;
    set_pin(b, b->oc_level);
}

static void act_on_match(board *b) { /* table 17-3: COM1A 1 toggles the pin, 2 clears and 3 sets it */
    int com = b->avr->data[TCCR1A] >> 6;
    if (com) set_pin(b, com == 1 ? !b->oc_level : com == 3);
}

static void on_match(avr_irq_t *irq, uint32_t pending, void *parameter) {
    (void)irq;
    if (pending) act_on_match(parameter);
}

static void on_force(avr_t *avr, avr_io_addr_t address, uint8_t value, void *parameter) {
    (void)avr, (void)address;
    if (value & FOC1A) act_on_match(parameter);
}

static void on_oc_pin(avr_irq_t *irq, uint32_t level, void *parameter) {
    board *b = parameter;
    (void)irq;
    int at_wrap = b->avr->cycle - b->timer1->tov_base < TIMER1_TICK;
    if (at_wrap && (int)(level & 1) != b->oc_level) b->counters[ARTEFACTS]++;
}

static void on_port(avr_irq_t *irq, uint32_t level, void *parameter) {
    board *b = parameter;
    (void)irq;
    if (b->avr->data[TCCR1A] >> 6 == 0) set_pin(b, level & 1); /* COM1A = 0: the port owns the pin */
}

static avr_cycle_count_t on_pilot(avr_t *avr, avr_cycle_count_t when, void *parameter) {
    board *b = parameter;
    (void)avr, (void)when;
    avr_raise_irq(b->pilot_pin, pop(&b->pilot));
    return is_empty(&b->pilot) ? 0 : next_at(&b->pilot);
}

/* ---- running ---- */

static avr_cycle_count_t on_stop(avr_t *avr, avr_cycle_count_t when, void *parameter) {
    (void)avr, (void)when, (void)parameter;
    return 0;
}

static void no_sleep(avr_t *avr, avr_cycle_count_t cycles) { (void)avr, (void)cycles; }

static void call_at(board *b, uint64_t at, avr_cycle_timer_t timer, void *parameter) {
    avr_cycle_timer_register(b->avr, at > b->avr->cycle ? at - b->avr->cycle : 0, timer, parameter);
}

static void arm(board *b) { /* a reset clears all timers of the simulator, including those of the environment */
    call_at(b, b->until, on_stop, b);
    for (int i = 0; i < UARTS; i++)
        if (!is_empty(&b->lines[i].bytes)) call_at(b, next_at(&b->lines[i].bytes), on_line, &b->lines[i]);
    if (!is_empty(&b->pilot)) call_at(b, next_at(&b->pilot), on_pilot, b);
}

static uint16_t swap_code(board *b, uint32_t address, uint16_t code) {
    uint8_t *place = b->avr->flash + address;
    uint16_t old = place[0] | place[1] << 8;
    place[0] = code & 0xFF, place[1] = code >> 8;
    return old;
}

static void on_reset(avr_t *avr) {
    board *b = avr->custom.data;
    if (b->core_reset) b->core_reset(avr);
    for (int i = 0; i < PARTS; i++) {
        if (b->stopped[i]) swap_code(b, b->part_address[i], b->part_code[i]);
        b->stopped[i] = 0;
    }
    b->lines[0].is_waiting = b->lines[1].is_waiting = 0;
    arm(b);
}

int sim_run(board *b, uint64_t until) {
    b->until = until;
    arm(b);
    while (b->avr->cycle < until) {
        avr_run_t usual = b->avr->run;
        b->avr->run_cycle_limit = LONGEST_RUN; /* many instructions a call; a reset puts 1 */
        int state = avr_run(b->avr);
        if (state == cpu_Done || state == cpu_Crashed || state == cpu_Stopped) {
            if (!b->is_flipped || !(b->avr->data[WDTCSR] & WDE)) return state;
            b->avr->state = cpu_Sleeping, b->avr->sreg[S_I] = 0;
            b->avr->cycle += STANDSTILL;
        }
        if (usual != avr_callback_run_raw) b->counters[WATCHDOG_RESETS]++;
    }
    return 0;
}

void sim_close(board *b) {
    queue *all[] = {&b->sent, &b->edges, &b->pilot, &b->lines[0].bytes, &b->lines[1].bytes};
    for (size_t i = 0; i < sizeof all / sizeof *all; i++) free(all[i]->at), free(all[i]->value);
    b->avr->custom.deinit = NULL;
    avr_terminate(b->avr);
    free(b->avr);
    free(b);
}

static void add_phase_correct_mode(avr_timer_t *timer) { /* mode 1 of each; what simavr has is left as it is */
    const avr_timer_wgm_t to_255 = AVR_TIMER_WGM_FCPWM8();
    if (timer->wgm_op[1].kind == avr_timer_wgm_none) timer->wgm_op[1] = to_255;
}

static void connect_pins(board *b) {
    avr_t *avr = b->avr;
    for (avr_io_t *io = avr->io_port; io; io = io->next) {
        if (!strcmp(io->kind, "timer")) {
            add_phase_correct_mode((avr_timer_t *)io);
            if (((avr_timer_t *)io)->name == '1') b->timer1 = (avr_timer_t *)io;
        }
        for (int i = 0; i < UARTS; i++)
            if (!strcmp(io->kind, "uart") && ((avr_uart_t *)io)->name == '0' + i) b->lines[i].uart = (avr_uart_t *)io;
    }
    for (int i = 0; i < UARTS; i++) {
        uint32_t quiet = 0; /* neither a wall-clock sleep while polling nor a copy on the console */
        avr_ioctl(avr, AVR_IOCTL_UART_SET_FLAGS('0' + i), &quiet);
        b->lines[i].owner = b;
        b->lines[i].input = avr_io_getirq(avr, AVR_IOCTL_UART_GETIRQ('0' + i), UART_IRQ_INPUT);
        avr_irq_register_notify(b->lines[i].input + (UART_IRQ_OUT_XON - UART_IRQ_INPUT), on_room, &b->lines[i]);
    }
    avr_irq_register_notify(avr_io_getirq(avr, AVR_IOCTL_UART_GETIRQ('0'), UART_IRQ_OUTPUT), on_sent, b);
    avr_irq_register_notify(avr_io_getirq(avr, AVR_IOCTL_TIMER_GETIRQ('1'), TIMER_IRQ_OUT_COMP), on_oc_pin, b);
    avr_irq_register_notify(avr_get_interrupt_irq(avr, TIMER1_COMPA) + AVR_INT_IRQ_PENDING, on_match, b);
    avr_register_io_write(avr, TCCR1C, on_force, b);
    avr_irq_register_notify(avr_io_getirq(avr, AVR_IOCTL_IOPORT_GETIRQ('B'), 5), on_port, b);
    avr_irq_register_notify(avr_io_getirq(avr, AVR_IOCTL_IOPORT_GETIRQ('B'), IOPORT_IRQ_DIRECTION_ALL), on_direction, b);
    b->pilot_pin = avr_io_getirq(avr, AVR_IOCTL_IOPORT_GETIRQ('L'), 0);
    avr_raise_irq(b->pilot_pin, 1); /* an open input with its pull-up is high */
}

board *sim_open(const char *elf_path, uint32_t seed) {
    avr_global_logger_set(keep_error);
    elf_firmware_t elf;
    memset(&elf, 0, sizeof elf);
    snprintf(last_error, sizeof last_error, "no code in the file");
    if (elf_read_firmware(elf_path, &elf) || !elf.flashsize) return NULL;
    board *b = calloc(1, sizeof *b);
    avr_t *avr = b ? avr_make_mcu_by_name("atmega2560") : NULL;
    if (!avr) return free(b), NULL;
    b->avr = avr;
    avr_init(avr);
    avr_load_firmware(avr, &elf);
    avr->frequency = CLOCK_HZ;
    avr->sleep = no_sleep;
    for (uint32_t i = RAM_START; i <= avr->ramend; i++) /* random memory at power-on */
        avr->data[i] = (seed = seed * 1664525u + 1013904223u) >> 24;
    for (uint32_t i = 0; i < elf.symbolcount; i++)
        if (!strcmp(elf.symbol[i]->symbol, "loop")) b->part_address[LOOP] = elf.symbol[i]->addr;
    b->part_address[PULSES] = TIMER1_COMPA * VECTOR_BYTES;
    connect_pins(b);
    avr->custom.data = b;
    b->core_reset = avr->reset;
    avr->reset = on_reset;
    return b;
}

const char *sim_error(void) { return last_error; }
uint64_t sim_cycle(const board *b) { return b->avr->cycle; }
int sim_pin(const board *b) { return b->pin_level; }
int sim_led(const board *b) { return b->avr->data[PORTB] >> 7 & 1; } /* pin 13 is PB7 */
uint32_t sim_counter(const board *b, int which) { return b->counters[which]; }

void sim_send(board *b, int uart, const uint8_t *bytes, size_t count) {
    line *l = &b->lines[uart];
    if (l->free_at < b->avr->cycle * NINTHS) l->free_at = b->avr->cycle * NINTHS;
    for (size_t i = 0; i < count; i++, l->free_at += BYTE_NINTHS)
        push(&l->bytes, (l->free_at + BYTE_NINTHS) / NINTHS, bytes[i]);
}

void sim_drive_pilot(board *b, const uint64_t *at, const uint8_t *levels, size_t count) {
    for (size_t i = 0; i < count; i++) push(&b->pilot, at[i], levels[i]);
}

size_t sim_receive(board *b, uint8_t *bytes, size_t most) { /* bytes that have left the chip completely */
    size_t count = 0;
    while (count < most && !is_empty(&b->sent) && next_at(&b->sent) <= b->avr->cycle) bytes[count++] = pop(&b->sent);
    return count;
}

size_t sim_take_edges(board *b, uint64_t *at, uint8_t *levels, size_t most) {
    size_t count = 0;
    for (; count < most && !is_empty(&b->edges); count++)
        at[count] = next_at(&b->edges), levels[count] = pop(&b->edges);
    return count;
}

/* Part 0, the next call of loop() never returns; 1, Timer1's interrupt does nothing. A reset ends it. */
int sim_stop(board *b, int part) {
    static const uint16_t instead[PARTS] = {JUMP_TO_ITSELF, RETURN_FROM_INTERRUPT};
    if (!b->part_address[part]) return -1;
    if (!b->stopped[part]) b->part_code[part] = swap_code(b, b->part_address[part], instead[part]);
    b->stopped[part] = 1;
    return 0;
}

int sim_peek(const board *b, uint16_t address) { return b->avr->data[address]; }

/* Turn one bit over, of a register, an I/O register (with what the write changes in the chip) or of memory. */
void sim_flip(board *b, uint16_t address, uint8_t bit) {
    avr_t *avr = b->avr;
    uint8_t value = avr->data[address] ^ (1 << bit);
    avr_io_write_t write = NULL;
    b->is_flipped = 1;
    if (address == SREG) {
        avr->sreg[bit] ^= 1;
        return;
    }
    if (address >= 32 && address < RAM_START && address != SPL && address != SPL + 1)
        write = avr->io[AVR_DATA_TO_IO(address)].w.c;
    if (write)
        write(avr, address, value, avr->io[AVR_DATA_TO_IO(address)].w.param);
    else
        avr->data[address] = value;
}

void sim_reset(board *b) { /* the reset button, or a host that opens the port: memory stays */
    avr_reset(b->avr);
    avr_regbit_set(b->avr, b->avr->reset_flags.extrf);
}
