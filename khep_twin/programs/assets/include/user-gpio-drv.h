/* Requests to /dev/user-gpio, the robot's driver of pins, for K-Team's library: its published sources lack
   this header. `control_gpio` in ../shim_devices.c answers them. */

#ifndef KHEP_TWIN_USER_GPIO_DRV_H
#define KHEP_TWIN_USER_GPIO_DRV_H

#include <sys/ioctl.h>

typedef struct { unsigned gpio; char label[32]; } GPIO_Request_t;
typedef struct { unsigned gpio; int value; } GPIO_Value_t;

#define GPIO_IOCTL_REQUEST _IOW('G', 0x80, GPIO_Request_t)
#define GPIO_IOCTL_FREE _IOW('G', 0x81, unsigned)
#define GPIO_IOCTL_DIRECTION_INPUT _IOW('G', 0x82, unsigned)
#define GPIO_IOCTL_DIRECTION_OUTPUT _IOW('G', 0x83, GPIO_Value_t)
#define GPIO_IOCTL_GET_VALUE _IOWR('G', 0x84, GPIO_Value_t)
#define GPIO_IOCTL_SET_VALUE _IOW('G', 0x85, GPIO_Value_t)

#endif
