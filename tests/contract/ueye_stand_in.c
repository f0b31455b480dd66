/* Stands in for IDS' shared library libueye_api: as much of it as the driver calls, after the maker's manual.

Two cameras of FACT's models (with fewer pixels): a grey one and one with colours. Time is the computer's. What makes it
a test: pixel clocks limit exposures, exposures are made in steps, settings can be refused, and pictures say which
trigger they are of. Functions named stand_in_* are for tests. */

#define _POSIX_C_SOURCE 200809L
#include <stdint.h>
#include <stdlib.h>
#include <string.h>
#include <time.h>

enum { SUCCESS = 0, NO_SUCCESS = -1, INVALID_HANDLE = 1, CANT_OPEN = 3, INVALID_PARAMETER = 125, NOT_SUPPORTED = 155 };
enum { USE_DEVICE_ID = 0x8000, GET = 0x8000, N_CAMERAS = 2 };
enum { CM_MONO8 = 6, CM_MONO10 = 34, CM_MONO12 = 26, CM_MONO16 = 28, CM_BGR8 = 1 };
enum { NOT_FINISHED = 0, FINISHED = 1, CAPTURE_STATUS = 3 };
static const double EXPOSURE_STEP_MS = 0.05, SHORTEST_MS = 0.05, READOUT_S = 0.005, MHZ_S = 40.0;
static const uint32_t CLOCKS_MHZ[] = {5, 10, 20, 40};
static const int SIDES_PX[N_CAMERAS][2] = {{1280, 960}, {1024, 768}};

#pragma pack(push, 8)
typedef struct { uint32_t camera_id, device_id, sensor_id, in_use; char serial[16], model[16]; uint32_t status,
    reserved[2]; char full_model[32]; uint32_t reserved2[5]; } CameraInfo;
typedef struct { uint32_t count; CameraInfo cameras[N_CAMERAS]; } CameraList;
typedef struct { uint16_t id; char name[32]; char colour_mode; uint32_t width, height; int32_t gains[4], global_shutter;
    uint16_t pixel_size; char upper_left; char reserved[13]; } SensorInfo;
typedef struct { int32_t x, y, width, height; } Rect;
#pragma pack(pop)

static struct {
    int is_open, is_gone, is_losing, refuses_gain, colour_mode, binning, gain, pitch, n_triggers, is_exposing, autos;
    Rect region;
    uint32_t clock_mhz;
    double exposure_ms, rate_per_s, done_s;
    char *memory;
} camera[N_CAMERAS];

static double now_s(void) {
    struct timespec t;
    clock_gettime(CLOCK_MONOTONIC, &t);
    return (double)t.tv_sec + 1e-9 * (double)t.tv_nsec;
}

/* Handles count from 1. */
#define OPENED(handle) \
    if (handle < 1 || handle > N_CAMERAS || !camera[handle - 1].is_open) return INVALID_HANDLE; \
    if (camera[handle - 1].is_gone) return NO_SUCCESS; \
    __typeof__(camera[0]) *c = &camera[handle - 1]

void stand_in_reset(void) { memset(camera, 0, sizeof camera); }
void stand_in_lose_next(int n) { camera[n].is_losing = 1; }
void stand_in_take_away(int n) { camera[n].is_gone = 1; }
void stand_in_refuse_gain(int n) { camera[n].refuses_gain = 1; }
int stand_in_clock_mhz(int n) { return (int)camera[n].clock_mhz; }
int stand_in_x(int n) { return camera[n].region.x; }
int stand_in_automatics(int n) { return camera[n].autos; }

int is_GetNumberOfCameras(int32_t *n) {
    *n = 0;
    for (int i = 0; i < N_CAMERAS; i++) *n += !camera[i].is_gone;
    return SUCCESS;
}

int is_GetCameraList(CameraList *list) {
    uint32_t n = 0;
    for (int i = 0; i < N_CAMERAS && n < list->count; i++) {
        if (camera[i].is_gone) continue;
        CameraInfo *info = &list->cameras[n++];
        memset(info, 0, sizeof *info);
        info->camera_id = info->device_id = (uint32_t)i + 1;
        info->in_use = (uint32_t)camera[i].is_open;
        strcpy(info->serial, i == 0 ? "4002795719" : "4102602113");
        strcpy(info->full_model, i == 0 ? "UI148xSE-M" : "DCU223C");
    }
    list->count = n;
    return SUCCESS;
}

int is_InitCamera(uint32_t *handle, void *window) {
    (void)window;
    uint32_t id = *handle & ~(uint32_t)USE_DEVICE_ID;
    if (!(*handle & USE_DEVICE_ID) || id < 1 || id > N_CAMERAS || camera[id - 1].is_gone || camera[id - 1].is_open)
        return CANT_OPEN;
    int refuses = camera[id - 1].refuses_gain;
    memset(&camera[id - 1], 0, sizeof camera[0]);
    camera[id - 1].is_open = 1;
    camera[id - 1].refuses_gain = refuses;
    camera[id - 1].gain = 50;
    camera[id - 1].autos = 0x7;
    *handle = id;
    return SUCCESS;
}

int is_ExitCamera(uint32_t handle) {
    OPENED(handle);
    free(c->memory);
    c->memory = NULL;
    c->is_open = c->is_exposing = 0;
    return SUCCESS;
}

int is_ResetToDefault(uint32_t handle) { OPENED(handle); c->clock_mhz = 40; c->rate_per_s = 1.0; return SUCCESS; }
int is_SetDisplayMode(uint32_t handle, int mode) { OPENED(handle); (void)c; return mode == 1 ? SUCCESS : NO_SUCCESS; }
int is_SetGainBoost(uint32_t handle, int mode) { OPENED(handle); (void)c; (void)mode; return NOT_SUPPORTED; }
int is_SetHardwareGamma(uint32_t handle, int mode) { OPENED(handle); (void)c; (void)mode; return NOT_SUPPORTED; }
int is_SetTimeout(uint32_t handle, uint32_t mode, uint32_t ticks) { OPENED(handle); (void)c; (void)mode; (void)ticks;
    return SUCCESS; }
int is_SetExternalTrigger(uint32_t handle, int mode) { OPENED(handle); (void)c; return mode == 4104 ? SUCCESS :
    NO_SUCCESS; }

/* Gain, shutter and white balance are on when the camera is opened; there is no automatic frame rate, nor any on the
sensor. */
int is_SetAutoParameter(uint32_t handle, int parameter, double *value, double *second) {
    OPENED(handle);
    (void)second;
    int number = (parameter - 34816) / 2;
    if (number < 0 || number > 2) return NOT_SUPPORTED;
    if (parameter % 2) *value = (c->autos >> number) & 1;
    else if (*value == 0.0) c->autos &= ~(1 << number);
    return SUCCESS;
}

int is_Gamma(uint32_t handle, uint32_t command, void *value, uint32_t size) {
    OPENED(handle);
    (void)c;
    if (size != 4) return INVALID_PARAMETER;
    if (command == 3) *(int32_t *)value = 100;
    return SUCCESS;
}

int is_GetSensorInfo(uint32_t handle, SensorInfo *info) {
    OPENED(handle);
    (void)c;
    memset(info, 0, sizeof *info);
    info->colour_mode = handle == 1 ? 1 : 2;
    info->width = (uint32_t)SIDES_PX[handle - 1][0];
    info->height = (uint32_t)SIDES_PX[handle - 1][1];
    return SUCCESS;
}

int is_SetColorMode(uint32_t handle, int mode) {
    OPENED(handle);
    if (mode == GET) return c->colour_mode;
    if (mode == CM_MONO12 || mode == CM_MONO16) return INVALID_PARAMETER; /* the sensors have 10 bit */
    c->colour_mode = mode;
    return SUCCESS;
}

int is_SetBinning(uint32_t handle, int mode) {
    OPENED(handle);
    if (mode == GET) return c->binning;
    if (mode != 0 && mode != 3) return NOT_SUPPORTED;
    c->binning = mode;
    return SUCCESS;
}

int is_AOI(uint32_t handle, uint32_t command, void *value, uint32_t size) {
    OPENED(handle);
    Rect *r = value;
    int divisor = c->binning ? 2 : 1;
    if (command == 17 && size == 8) r->x = 4, r->y = 2;
    else if (command == 2 && size == 16) *r = c->region;
    else if (command == 1 && size == 16 && r->x % 4 == 0 && r->y % 2 == 0 && r->width > 0 && r->height > 0 &&
             r->x + r->width <= SIDES_PX[handle - 1][0] / divisor &&
             r->y + r->height <= SIDES_PX[handle - 1][1] / divisor) c->region = *r;
    else return INVALID_PARAMETER;
    return SUCCESS;
}

int is_PixelClock(uint32_t handle, uint32_t command, void *value, uint32_t size) {
    OPENED(handle);
    const uint32_t n = sizeof CLOCKS_MHZ / sizeof *CLOCKS_MHZ;
    if (command == 1 && size == 4) *(uint32_t *)value = n;
    else if (command == 2 && size == sizeof CLOCKS_MHZ) memcpy(value, CLOCKS_MHZ, size);
    else if (command == 6 && size == 4) c->clock_mhz = *(uint32_t *)value;
    else return INVALID_PARAMETER;
    return SUCCESS;
}

int is_GetFrameTimeRange(uint32_t handle, double *shortest_s, double *longest_s, double *step_s) {
    OPENED(handle);
    *longest_s = MHZ_S / c->clock_mhz;
    *shortest_s = *longest_s / 100.0;
    *step_s = 1e-4;
    return SUCCESS;
}

int is_SetFrameRate(uint32_t handle, double rate_per_s, double *made_per_s) {
    OPENED(handle);
    double least_per_s = c->clock_mhz / MHZ_S;
    *made_per_s = c->rate_per_s = rate_per_s < least_per_s ? least_per_s : rate_per_s;
    return SUCCESS;
}

int is_Exposure(uint32_t handle, uint32_t command, void *value, uint32_t size) {
    OPENED(handle);
    double *ms = value, longest_ms = 1000.0 / c->rate_per_s;
    if (command == 6 && size == 24) {
        ms[0] = SHORTEST_MS;
        ms[1] = longest_ms;
        ms[2] = EXPOSURE_STEP_MS;
    } else if (command == 7 && size == 8) {
        *ms = c->exposure_ms;
    } else if (command == 12 && size == 8) {
        if (*ms < SHORTEST_MS || *ms > longest_ms + 1e-9) return INVALID_PARAMETER;
        *ms = c->exposure_ms = EXPOSURE_STEP_MS * (double)(int64_t)(*ms / EXPOSURE_STEP_MS + 0.5);
    } else {
        return INVALID_PARAMETER;
    }
    return SUCCESS;
}

int is_SetHardwareGain(uint32_t handle, int master, int red, int green, int blue) {
    OPENED(handle);
    (void)red, (void)green, (void)blue;
    if (master == GET) return c->gain;
    if (master < 0 || master > 100) return INVALID_PARAMETER;
    if (!c->refuses_gain) c->gain = master;
    return SUCCESS;
}

/* Rows are padded to multiples of four bytes, as the manual says. */
int is_AllocImageMem(uint32_t handle, int width, int height, int bits, char **memory, int *id) {
    OPENED(handle);
    c->pitch = (width * bits / 8 + 3) / 4 * 4;
    *memory = c->memory = calloc((size_t)height, (size_t)c->pitch);
    *id = 1;
    return SUCCESS;
}

int is_SetImageMem(uint32_t handle, char *memory, int id) { OPENED(handle); return memory == c->memory && id == 1 ?
    SUCCESS : INVALID_PARAMETER; }
int is_GetImageMemPitch(uint32_t handle, int *pitch) { OPENED(handle); *pitch = c->pitch; return SUCCESS; }

int is_FreezeVideo(uint32_t handle, int wait) {
    OPENED(handle);
    if (wait != 0 || c->is_exposing) return NO_SUCCESS;
    c->is_exposing = 1;
    c->n_triggers++;
    c->done_s = now_s() + c->exposure_ms / 1000.0 + READOUT_S;
    return SUCCESS;
}

int is_StopLiveVideo(uint32_t handle, int mode) { OPENED(handle); (void)mode; c->is_exposing = 0; return SUCCESS; }

/* A pixel is x + 2 y + the number of the trigger, modulo 2 to the depth, in each channel plus its number. */
static void paint(__typeof__(camera[0]) *c) {
    int n_channels = c->colour_mode == CM_BGR8 ? 3 : 1, is_wide = c->colour_mode == CM_MONO10;
    for (int y = 0; y < c->region.height; y++) {
        char *row = c->memory + (size_t)y * (size_t)c->pitch;
        for (int x = 0; x < c->region.width; x++)
            for (int k = 0; k < n_channels; k++) {
                int value = x + 2 * y + c->n_triggers + k;
                if (is_wide) ((uint16_t *)row)[x] = (uint16_t)(value % 1024);
                else ((uint8_t *)row)[x * n_channels + k] = (uint8_t)value;
            }
    }
}

int is_IsVideoFinish(uint32_t handle, int *state) {
    OPENED(handle);
    int asks_for_errors = *state == CAPTURE_STATUS;
    *state = NOT_FINISHED;
    if (!c->is_exposing) { *state = FINISHED; return SUCCESS; }
    if (now_s() < c->done_s) return SUCCESS;
    c->is_exposing = 0;
    *state = FINISHED;
    if (c->is_losing && asks_for_errors) *state = CAPTURE_STATUS;
    else paint(c);
    c->is_losing = 0;
    return SUCCESS;
}
